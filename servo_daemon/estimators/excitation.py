"""What the motion says about each parameter now: information gained over the last seconds, with hysteresis.

`information` is the increase of 1/σ² that the samples of a tick brought (as if the parameter were free). A parameter is
excited when the last `WINDOW_S` alone would determine it to `ENTER` (relative, 1 σ); it stops being so at `LEAVE`.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64

WINDOW_S = 5.0
ENTER, LEAVE = 0.10, 0.20

#: Why a parameter is not visible, in words.
REASONS = {
    "R": "hardly any current: R not visible",
    "L": "current hardly changes: L not visible",
    "K": "hardly any speed or torque: K not visible",
    "J": "speed hardly changes: J not visible",
    "B": "hardly any speed, or only one: B not visible",
    "Tc": "no motion in both directions: Tc not visible",
}


class Excitation:
    """Flags for n parameters, fed a tick at a time.

    Args:
        scales: shape (n,): what counts as one unit of each coordinate (1 for logarithms).
    """

    def __init__(self, scales: F64) -> None:
        self._scales = scales
        self._window: deque[tuple[float, F64]] = deque()
        self._sum_s = 0.0
        self.excited: NDArray[np.bool_] = np.zeros(len(scales), dtype=bool)

    def reset(self) -> None:
        self._window.clear()
        self._sum_s = 0.0
        self.excited[:] = False

    def update(self, information: F64, duration_s: float) -> None:
        """information: shape (n,), gained in this tick of `duration_s`."""
        self._window.append((duration_s, information))
        self._sum_s += duration_s
        while self._sum_s - self._window[0][0] >= WINDOW_S:
            self._sum_s -= self._window.popleft()[0]
        std = self.std()
        self.excited = np.where(self.excited, std < LEAVE, std < ENTER)

    def std(self) -> F64:
        """What the window alone would leave of each coordinate, 1 σ over its scale; shape (n,)."""
        total = np.sum([information for _, information in self._window], axis=0)
        return np.asarray(1.0 / (np.sqrt(np.maximum(total, 1e-300)) * self._scales))


def reason(name: str) -> str:
    return REASONS.get(name, f"the motion does not show {name} now")
