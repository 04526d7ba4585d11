"""What a quantised voltage leaves open of the inductance.

A filter allows for noise that is in the applied voltage and not in the record: it is independent of what is recorded,
and averages out. Rounding is the other way round. The error of steps q stands in the record and not in the motor, so
that it is in the innovations *and* in their derivatives by the parameters (errors in variables): the filter solves
Σ S ε = 0, and E S ε is not 0.

The current answers to changes of the voltage, each of which is off by q²/6 (two roundings). Where the changes Δv
within the winding's time are not large against q, the share s = (q²/6)/E Δv² of their power is rounding that the
current does not follow. The response 1 − exp(−x) with x = h R/L that is seen of a change is too small by s:
δ ln L = s (exp(x) − 1)/x. As that grows faster than L falls, it is evaluated at an L that is smaller by as much. (Of a
winding that is slow against the sampling this is the share itself. What a steady Kalman filter of the current is off by
was within it, to 4 %, in 180 cases of x = 0.05 to 2, white to slow voltages and all shares of sensor noise.)

Parameters that the filter's covariance couples to L are biased with it (`along`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from servo_daemon.samples import F64

#: Averaging length of the changes, ticks (chosen; half and twice move no tracking figure).
_TICKS = 50.0
#: The changes are those within the winding's time; they are averaged anew once it is another by this factor (chosen;
#: free within half and twice).
_OTHER_LAG = 1.5
#: Beyond this, L is not known at all (a factor of twenty, e³).
_MOST_STD = 3.0
#: Largest h R/L that is evaluated: e⁵⁰/50 times any share of rounding is beyond `_MOST_STD`.
_MOST_PERIODS = 50.0


class QuantisedInput:
    """Counts the steps of one drive's recorded voltage.

    Attributes:
        lsb_V: its step; 0: none is to be seen.
    """

    def __init__(self) -> None:
        self.lsb_V = 0.0
        self._change_square, self._ticks = 0.0, 0.0  # V², mean over so many ticks
        self._lag = 1  # samples

    def take(self, voltage_V: F64, period_s: float, value: Mapping[str, float]) -> None:
        """Take a tick's samples.

        Args:
            value: of R and L, natural units.
        """
        lag = min(max(1, round(value["L"] / value["R"] / max(period_s, 1e-9))), len(voltage_V) - 1)
        if lag < 1 or self.lsb_V == 0.0:
            return
        if not 1.0 / _OTHER_LAG < lag / self._lag < _OTHER_LAG:
            self._lag, self._ticks = lag, 0.0
        change = voltage_V[lag:] - voltage_V[:-lag]
        square = float(change @ change) / len(change)
        self._ticks = min(self._ticks + 1.0, _TICKS)
        self._change_square += (square - self._change_square) / self._ticks

    def inductance_std(self, period_s: float, value: Mapping[str, float]) -> float:
        """1 σ of ln L.

        Args:
            value: of R and L, natural units, as estimated.
        """
        if self.lsb_V == 0.0 or self._ticks == 0.0:
            return 0.0
        periods = min(period_s * value["R"] / value["L"], _MOST_PERIODS)
        share = self.lsb_V**2 / 6.0 / max(self._change_square, self.lsb_V**2 / 6.0)
        seen = min(share * _lost_of_change(periods), _MOST_STD)
        return min(share * _lost_of_change(min(periods * math.exp(seen), _MOST_PERIODS)), _MOST_STD)


def _lost_of_change(periods: float) -> float:
    """δ ln L over the share of the changes' power that is rounding."""
    return math.expm1(periods) / max(periods, 1e-9)


def along(covariance: F64, k: int, std: float) -> F64:
    """1 σ of all coordinates if coordinate k is off by `std` and the others follow it, shape (n,).

    Args:
        covariance: of the coordinates, shape (n, n).
    """
    return np.asarray(np.abs(covariance[:, k]) * (std / max(float(covariance[k, k]), 1e-300)))
