"""What the last windows of a motor say together: one alone may have held a motion that tells little.

Their mean with the inverse of their variances as weights. They are of one motor, with the same friction and the same
instruments, so part of their errors is common: the mean is taken to be no surer than the surest of them, and less sure
by the Birge ratio where they scatter more than they should (R. T. Birge, *Phys. Rev.* 40, 1932). Windows before one
that contradicts them do not count: the motor has changed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.learning.examples.drawing import CORE
from servo_daemon.learning.refresh.refresh import GATE
from servo_daemon.samples import F64


@dataclass(frozen=True)
class _Said:
    """One window's estimate: R, L, K, J, B as logarithms, all others as they are; by name."""

    time_s: float
    mean: Mapping[str, float]
    std: Mapping[str, float]

    def contradicts(self, other: _Said) -> bool:
        """Whether the two cannot be of one motor: beyond the gate that keeps an estimate out of the filter."""
        away = [(self.mean[n] - other.mean[n]) ** 2 / (self.std[n] ** 2 + other.std[n] ** 2) for n in CORE]
        return float(np.mean(away)) > GATE


class Recent:
    """The weighted mean of the last windows' estimates.

    Args:
        counts_for_s: device time after which a window counts no more: what it said is of the motor of then.
    """

    def __init__(self, counts_for_s: float) -> None:
        self._counts_for_s = counts_for_s
        self._windows: list[_Said] = []
        self._together: dict[str, tuple[float, float]] = {}

    def add(self, time_s: float, value: Mapping[str, float], std: Mapping[str, float]) -> None:
        """A window's estimate by name, SI units, with 1 σ."""
        mean = {n: math.log(v) if n in CORE else v for n, v in value.items()}
        new = _Said(time_s, mean, {n: std[n] / value[n] if n in CORE else std[n] for n in value})
        alike: list[_Said] = []
        for said in reversed(self._windows):
            if new.contradicts(said):
                break
            alike.insert(0, said)
        self._windows = [*alike, new]
        self._combine()

    def forget(self) -> None:
        """Forget all windows: the motor has changed."""
        self._windows, self._together = [], {}

    def of(self, name: str, now_s: float) -> tuple[float, float] | None:
        """A parameter and its 1 σ by the windows that count now; None: none does."""
        if self._windows and now_s - self._windows[0].time_s > self._counts_for_s:
            self._windows = [w for w in self._windows if now_s - w.time_s <= self._counts_for_s]
            self._combine()
        return self._together.get(name)

    @property
    def last_s(self) -> float | None:
        """Device time of the last window that counts."""
        return self._windows[-1].time_s if self._windows else None

    def _combine(self) -> None:
        self._together = {}
        for name in self._windows[-1].mean if self._windows else ():
            mean, std = _mean(*np.array([(w.mean[name], w.std[name]) for w in self._windows]).T)
            if name in CORE:
                mean, std = math.exp(mean), std * math.exp(mean)
            self._together[name] = mean, std


def _mean(value: F64, std: F64) -> tuple[float, float]:
    weight = std**-2.0
    mean = float(weight @ value / weight.sum())
    scatter = float(weight @ np.square(value - mean)) / max(len(value) - 1, 1)
    return mean, float(std.min()) * math.sqrt(max(scatter, 1.0))
