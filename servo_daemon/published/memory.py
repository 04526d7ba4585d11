"""The ring of the last minutes as an answer of the archive: the same form, whether the past is on disk or in memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servo_daemon.published.archive import Span
from servo_daemon.published.buckets import TRUTH, Buckets
from servo_daemon.published.history import HistoryRing
from servo_daemon.published.ring_rows import RingRows


def of_ring(found: RingRows) -> Buckets:
    """Rows as buckets; a simulated drive's true values become series of their own (`R_true`)."""
    n, m = len(found.time_s), len(found.truth)
    units = dict(zip(found.names, found.units, strict=True))
    return Buckets.of_rows(
        found.time_s,
        (*found.names, *(f"{name}{TRUTH}" for name in found.truth)),
        (*found.units, *(units[name] for name in found.truth)),
        (*found.is_parameter, *(False for _ in found.truth)),
        np.column_stack([found.value, *found.truth.values()]),
        np.column_stack([found.std, np.full((n, m), np.nan)]),
        np.column_stack([found.code, np.zeros((n, m), np.int8)]),
    )


def within(rows: Buckets, start_s: float, end_s: float) -> Buckets:
    """Rows from `start_s` to `end_s`, both inclusive, sorted by time."""
    rows = rows.take((rows.time_s >= start_s) & (rows.time_s <= end_s))
    return rows.take(np.argsort(rows.time_s, kind="stable"))


def memory_span(ring: HistoryRing, names: Sequence[str], start_s: float, end_s: float) -> Span:
    """What the ring still has of these series."""
    return Span("rows", start_s, end_s, within(of_ring(ring.since(0)).select(names), start_s, end_s))
