"""Lays sample blocks out for the filter and the regressions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servo_daemon.estimators.motor_rls import Stretch
from servo_daemon.plant.build import Drive
from servo_daemon.samples import F64, Quality, SampleBlock

#: A gap longer than this leaves the plant's states unknown; a shorter one is predicted through.
LONG_GAP_S = 0.25
#: Samples further apart than this many periods have lost some between them: no regular drive's jitter is as large.
_GAP_PERIODS = 2.5
#: Up to this many periods the motion is predicted through a gap; beyond, what the voltage did meanwhile counts more.
_SHORT_GAP_PERIODS = 3.5

_INVALID_BIT = {
    "voltage_V": Quality.VOLTAGE_INVALID,
    "current_A": Quality.CURRENT_INVALID,
    "position_rad": Quality.POSITION_INVALID,
    "velocity_rad_s": Quality.POSITION_INVALID,
    "torque_Nm": Quality.CURRENT_INVALID,
}
#: Most by which a standing encoder's variance is raised: 5000 samples on one count.
_MOST_DOUBT = 5e7
#: Beyond this a value is no measurement of a servo drive, whatever the drive says; and no square of it overflows.
_IMPOSSIBLE = {
    "voltage_V": 1e5,
    "current_A": 1e5,
    "position_rad": 1e12,  # years at any speed: it is counted on from turn to turn
    "velocity_rad_s": 1e7,
    "torque_Nm": 1e7,
}
INPUT: dict[Drive, str] = {"voltage": "voltage_V", "current": "current_A", "torque": "torque_Nm"}


def breaks(block: SampleBlock, last_s: float | None) -> list[int]:
    """Indices of samples before which the plant's state is lost: restarts and long gaps."""
    first = last_s is None or float(block.time_s[0]) - last_s <= LONG_GAP_S
    if first and float(block.time_s[-1] - block.time_s[0]) <= LONG_GAP_S and not block.quality.any():
        return []  # the usual case, without looking closer
    previous = np.concatenate([[block.time_s[0] if last_s is None else last_s], block.time_s[:-1]])
    lost = (block.time_s - previous > LONG_GAP_S) | ((block.quality & Quality.TIME_RESTART) != 0)
    return [int(k) for k in np.flatnonzero(lost)]


def gaps(block: SampleBlock, last_s: float | None, period_s: float | None) -> dict[int, bool]:
    """Indices of samples before which others are missing, as the driver says or as their times show, and whether the
    gap is a short one.

    Args:
        last_s: time of the sample before the block.
        period_s: usual distance of two samples; None: not known yet.
    """
    missing = (block.quality & Quality.GAP_BEFORE) != 0
    if period_s is None or last_s is None:
        return dict.fromkeys(np.flatnonzero(missing).tolist(), False)
    distance = np.diff(block.time_s, prepend=last_s)
    missing |= distance > _GAP_PERIODS * period_s
    return {k: bool(distance[k] <= _SHORT_GAP_PERIODS * period_s) for k in np.flatnonzero(missing).tolist()}


def channel(block: SampleBlock, name: str) -> tuple[F64, F64]:
    """Values (0 where they are no measurement) and validity (1 or 0) of a channel."""
    values: F64 = getattr(block, name)
    valid = np.abs(values) <= _IMPOSSIBLE[name]  # which a NaN is not
    if block.quality.any():
        valid &= (block.quality & _INVALID_BIT[name]) == 0
    if valid.all():
        return values, np.ones(len(values))
    return np.where(valid, values, 0.0), valid.astype(np.float64)


@dataclass(slots=True)
class Layout:
    """Lays blocks out as the filter's sample rows; remembers what the next row needs of the last."""

    drive: Drive
    measured: tuple[str, ...]
    last_s: float | None = None
    last_input: float = 0.0
    origin_s: float = 0.0
    position_lsb: float = 0.0
    _last_position: float = math.nan
    _same: int = 0

    def rows(self, block: SampleBlock, unknown_input_var: float) -> F64:
        """shape (n, 4 + 3 channels): t, h, input, extra variance, (y, valid, doubt)…

        Args:
            unknown_input_var: added variance where the input is not known and the last one is held.
        """
        n = len(block)
        out = np.ones((n, 4 + 3 * len(self.measured)))
        t = block.time_s - self.origin_s
        out[:, 0] = t
        first = 0.0 if self.last_s is None else float(block.time_s[0]) - self.last_s
        out[0, 1] = first
        out[1:, 1] = np.diff(block.time_s)
        u, valid = channel(block, INPUT[self.drive])
        known = np.concatenate([[self.last_input], u])
        source = np.maximum.accumulate(np.where(valid > 0, np.arange(1, n + 1), 0))
        out[:, 2] = known[source]
        out[:, 3] = (1.0 - valid) * unknown_input_var
        for k, name in enumerate(self.measured):
            out[:, 4 + 3 * k], out[:, 5 + 3 * k] = channel(block, name)
            if name == "position_rad" and self.position_lsb > 0:
                out[:, 6 + 3 * k] = self._standstill_doubt(out[:, 4 + 3 * k])
        self.last_s, self.last_input = float(block.time_s[-1]), float(out[-1, 2])
        return out

    def _standstill_doubt(self, position: F64) -> F64:
        """Factor on the encoder's variance, shape (n,): a count that stands still repeats one error, it does not
        average it. The k-th sample on the same count weighs 1/(2 k (k − 1)), so that however long it stands all of
        them together say little more than the first."""
        n = len(position)
        moved = np.abs(np.diff(position, prepend=self._last_position)) > 0.5 * self.position_lsb
        index = np.arange(n)
        begin = np.maximum.accumulate(np.where(moved, index, -1))
        same = np.where(begin >= 0, index - begin + 1, self._same + 1 + index)
        self._last_position, self._same = float(position[-1]), int(same[-1])
        return np.where(same > 1, np.minimum(2.0 * same * (same - 1.0), _MOST_DOUBT), 1.0)


def stretch_of(block: SampleBlock, origin_s: float, last_s: float | None, period_s: float | None) -> Stretch:
    """The block for the regressions; samples after a gap or with an invalid channel are not usable.

    Args:
        last_s, period_s: as for `gaps`.
    """
    usable = np.ones(len(block), dtype=bool)
    usable &= (block.quality & (Quality.GAP_BEFORE | Quality.TIME_RESTART)) == 0
    usable[list(gaps(block, last_s, period_s))] = False
    signals: dict[str, F64 | None] = {}
    for name in ("voltage_V", "current_A", "torque_Nm", "position_rad", "velocity_rad_s"):
        if getattr(block, name) is None:
            signals[name] = None
            continue
        signals[name], valid = channel(block, name)
        usable &= valid > 0
    return Stretch(
        block.time_s - origin_s,
        usable,
        signals["voltage_V"],
        signals["current_A"],
        signals["torque_Nm"],
        signals["position_rad"],
        signals["velocity_rad_s"],
    )
