"""From samples to filtered rows: stretches on an even grid, and the signals of both balances on it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servo_daemon.samples import F64, Quality, SampleBlock

#: Shorter pieces between gaps are left out: a filter settles over some tens of samples.
FEWEST = 50
#: Sampling instants that lie on an even grid to this part of the period are taken as they are.
_EVEN = 2e-3


@dataclass(frozen=True, slots=True)
class EvenStretch:
    """Uninterrupted samples on an even grid.

    Attributes:
        time_s: shape (n,).
        position: shape (n,), or None where only the speed is measured.
        velocity: shape (n,), or None.
        effort: torque or current: shape (n,) at the samples, or shape (n − 1,) its means from each sample to the next.
    """

    time_s: F64
    position: F64 | None
    velocity: F64 | None
    effort: F64

    @property
    def rate_Hz(self) -> float:
        return float((len(self.time_s) - 1) / (self.time_s[-1] - self.time_s[0]))

    @property
    def motion(self) -> F64:
        """What is differentiated: the position if there is one."""
        chosen = self.position if self.position is not None else self.velocity
        assert chosen is not None
        return chosen

    @property
    def by_intervals(self) -> bool:
        """Whether the effort is one of intervals."""
        return len(self.effort) < len(self.time_s)


def pieces(block: SampleBlock) -> list[SampleBlock]:
    """The uninterrupted parts of a block: cut where samples are missing and around those that are no measurement."""
    return _cut(block, Quality.GAP_BEFORE | Quality.TIME_RESTART)


def measured(block: SampleBlock) -> list[SampleBlock]:
    """The parts of a block between samples that are no measurement; others may be missing in them."""
    return _cut(block, Quality.TIME_RESTART)


def _cut(block: SampleBlock, where: Quality) -> list[SampleBlock]:
    invalid = Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID | Quality.POSITION_INVALID
    bad = (block.quality & int(invalid)) != 0
    begins = (block.quality & int(where)) != 0
    label = np.cumsum(begins | bad | np.concatenate([[False], bad[:-1]]))
    cuts = np.concatenate([[0], np.flatnonzero(np.diff(label)) + 1, [len(block)]])
    return [block.slice(int(a), int(b)) for a, b in pairwise(cuts) if not bad[a]]


def even_stretch(block: SampleBlock, effort: F64, period_s: float) -> EvenStretch:
    """An uninterrupted piece on an even grid.

    Args:
        effort: torque or current at the samples, shape (n,), or its means over the intervals, shape (n − 1,).
        period_s: about that of the grid, which ends with the last sample.
    """
    from scipy.interpolate import CubicSpline

    t = block.time_s - block.time_s[0]
    count = round(float(t[-1]) / period_s)
    grid = np.arange(count + 1) * float(t[-1]) / count
    even = len(grid) == len(t) and bool(np.all(np.abs(t - grid) < _EVEN * period_s))
    position, velocity = block.position_rad, block.velocity_rad_s
    if not even:
        position = None if position is None else np.asarray(CubicSpline(t, position - position[0])(grid) + position[0])
        velocity = None if velocity is None else np.interp(grid, t, velocity)
        effort = np.interp(grid, t, effort) if len(effort) == len(t) else _interval_means(t, effort, grid)
    return EvenStretch(grid + block.time_s[0], position, velocity, effort)


def _interval_means(time_s: F64, held: F64, grid: F64) -> F64:
    """Means over the grid's intervals of what has the mean `held`, shape (n − 1,), over each sample interval."""
    integral = np.concatenate([[0.0], np.cumsum(held * np.diff(time_s))])
    return np.asarray(np.diff(np.interp(grid, time_s, integral)) / np.diff(grid))
