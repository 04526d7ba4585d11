"""What a voltage that is recorded in coarse steps leaves open of the inductance.

The winding answers to changes of the voltage within its time constant L/R. Recorded in steps q, each change is off by
q²/6 (two roundings of q²/12); where the changes Δv are not large against q, the share

    s = (q²/6) / E Δv²,   Δv over L/R or one sample, whichever is longer,

of their power is rounding that the current does not follow. It is no noise that averages out: it stands in the
regressor, and attenuates (errors in variables). The response 1 − exp(−x) that is seen of a change after one sample,
x = h R/L, is too small by s, so that L comes out too large by

    δ ln L = s (exp(x) − 1)/x.

What goes with L in the filter's covariance is off with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from servo_daemon.samples import F64

#: The changes are averaged over so many ticks.
_TICKS = 50.0
#: Beyond this, L is not known at all.
_MOST_STD = 3.0


class CoarseInput:
    """One drive's recorded voltage.

    Attributes:
        lsb_V: its step; 0: none is to be seen.
    """

    def __init__(self) -> None:
        self.lsb_V = 0.0
        self._change_square: float | None = None  # V²

    def take(self, voltage_V: F64, period_s: float, value: Mapping[str, float]) -> None:
        """A tick's samples.

        Args:
            value: of R and L, natural units.
        """
        lag = min(max(1, round(value["L"] / value["R"] / max(period_s, 1e-9))), len(voltage_V) - 1)
        if lag < 1 or self.lsb_V == 0.0:
            return
        change = voltage_V[lag:] - voltage_V[:-lag]
        square = float(change @ change) / len(change)
        if self._change_square is None:
            self._change_square = square
        self._change_square += (square - self._change_square) / _TICKS

    def inductance_std(self, period_s: float, value: Mapping[str, float]) -> float:
        """1 σ of ln L."""
        if self.lsb_V == 0.0 or self._change_square is None:
            return 0.0
        share = self.lsb_V**2 / 6.0 / max(self._change_square, self.lsb_V**2 / 6.0)
        periods = min(period_s * value["R"] / value["L"], 50.0)
        return min(share * math.expm1(periods) / max(periods, 1e-9), _MOST_STD)


def along(covariance: F64, k: int, std: float) -> F64:
    """1 σ of all coordinates if coordinate k is off by `std` and the others follow it, shape (n,).

    Args:
        covariance: of the coordinates, shape (n, n).
    """
    return np.asarray(np.abs(covariance[:, k]) * (std / max(float(covariance[k, k]), 1e-300)))
