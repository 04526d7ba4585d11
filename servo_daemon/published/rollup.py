"""Joining and summing up buckets: pure functions on arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.published.buckets import STATUSES, Buckets
from servo_daemon.published.history import RATE_HZ
from servo_daemon.samples import F64

#: Times of rows differ in their last digits after they were stored; those of buckets are multiples of their length.
_SAME_S = 1e-6
#: From one row to the next, s (`RATE_HZ` of the ring).
_ROW_S = 1.0 / RATE_HZ


def join(parts: Sequence[Buckets]) -> Buckets:
    """All rows of the parts, sorted by time. Series that a part lacks are unknown there.

    Raises:
        ValueError: parts of buckets of different lengths.
    """
    parts = [p for p in parts if len(p)]
    if not parts:
        return Buckets.empty()
    if len({p.period_s for p in parts}) > 1:
        raise ValueError("buckets of different lengths cannot be joined; roll them up first")
    first = parts[0]
    if any((p.names, p.is_parameter) != (first.names, first.is_parameter) for p in parts):
        kinds = {n: (u, k) for p in parts for n, u, k in zip(p.names, p.units, p.is_parameter, strict=True)}
        parts = [_widened(p, kinds) for p in parts]
    joined = replace(
        parts[0],
        time_s=np.concatenate([p.time_s for p in parts]),
        count=np.concatenate([p.count for p in parts]),
        mean=np.concatenate([p.mean for p in parts]),
        low=np.concatenate([p.low for p in parts]),
        high=np.concatenate([p.high for p in parts]),
        spread=np.concatenate([p.spread for p in parts]),
        std=np.concatenate([p.std for p in parts]),
        status=np.concatenate([p.status for p in parts]),
    )
    if np.any(np.diff(joined.time_s) < 0):
        joined = joined.take(np.argsort(joined.time_s, kind="stable"))
    return joined


def _widened(part: Buckets, kinds: dict[str, tuple[str | None, bool]]) -> Buckets:
    """With all these series, in this order."""
    n, at = len(part), {name: k for k, name in enumerate(part.names)}
    missing = len(part.names)
    index = [at.get(name, missing) for name in kinds]

    def floats(array: F64) -> F64:
        return np.concatenate([array, np.full((n, 1), np.nan)], axis=1)[:, index]

    none = np.zeros((n, 1), np.int32)
    layers = np.zeros((n, 1, len(STATUSES)), np.int32)
    return Buckets(
        part.period_s, part.time_s, tuple(kinds), tuple(u for u, _ in kinds.values()),
        tuple(k for _, k in kinds.values()), np.concatenate([part.count, none], axis=1)[:, index],
        floats(part.mean), floats(part.low), floats(part.high), floats(part.spread), floats(part.std),
        np.concatenate([part.status, layers], axis=1)[:, index],
    )  # fmt: skip


def roll_up(rows: Buckets, period_s: float) -> Buckets:
    """Rows or shorter buckets summed up into buckets of `period_s`; parts of one bucket, too, become one.

    The mean is weighted by the number of rows, the spread is that of all rows about it (law of total variance). The
    published standard deviations are combined as their root mean square, not divided by the number of rows: errors of
    one filter's neighbouring estimates are nearly the same error.

    Args:
        rows: sorted by time, in buckets no longer than `period_s`.
    """
    if not len(rows):
        return replace(Buckets.empty(), period_s=period_s)
    key = np.floor(rows.time_s / period_s + _SAME_S)
    starts = np.flatnonzero(np.diff(key, prepend=key[0] - 1.0))
    if len(starts) == len(rows) and rows.period_s == period_s:
        return rows
    count = np.add.reduceat(rows.count, starts, axis=0, dtype=np.int32)
    weight = rows.count.astype(float)
    total = np.add.reduceat(weight, starts, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.add.reduceat(weight * _or_zero(rows.mean), starts, axis=0) / total
        lengths = np.diff(starts, append=len(rows))
        away = _or_zero(rows.mean - np.repeat(mean, lengths, axis=0))
        square = weight * (_or_zero(rows.spread) ** 2 + away**2)
        spread = np.sqrt(np.add.reduceat(square, starts, axis=0) / total)
        with_std = weight * np.isfinite(rows.std)
        std = np.sqrt(
            np.add.reduceat(with_std * _or_zero(rows.std) ** 2, starts, axis=0)
            / np.add.reduceat(with_std, starts, axis=0)
        )
    return Buckets(
        period_s, key[starts] * period_s, rows.names, rows.units, rows.is_parameter, count, mean,
        np.fmin.reduceat(rows.low, starts, axis=0), np.fmax.reduceat(rows.high, starts, axis=0), spread, std,
        np.add.reduceat(rows.status, starts, axis=0, dtype=np.int32),
    )  # fmt: skip


def fewer(rows: Buckets, points: int) -> Buckets:
    """At most `points` (at least 2) buckets over the same time; of single rows where there are more, else as they are.
    Buckets become such of whole numbers of theirs, rows of tenths of a second."""
    if len(rows) <= points:
        return rows
    unit = rows.period_s or _ROW_S
    times = max(1, math.ceil((rows.time_s[-1] - rows.time_s[0]) / unit / points))
    while len(short := roll_up(rows, unit * times)) > points:
        times = math.ceil(1.1 * times + 0.1)
    return short


def _or_zero(array: F64) -> F64:
    return np.where(np.isfinite(array), array, 0.0)
