"""What a quantised voltage leaves open of the inductance.

A filter allows for noise that is in the applied voltage and not in the record: it is independent of what is recorded,
and averages out. Rounding is the other way round. The error e of steps q, σ_e² = q²/12, stands in the record and not in
the motor, so that it is in the innovations *and* in their derivatives by the parameters (errors in variables): the
filter solves Σ S ε = 0, and E S ε is not 0. Two limits:

A winding that is slow against the sampling. One current with a = exp(−x), b = (1 − a)/R, x = h R/L, the filter's gain κ
and F = a (1 − κ) has of the rounding

    x̃⁺ = F x̃ − b e                       (error of the current)
    S⁺ = F S − ∂a (1 − κ) x̃ + ∂b e       (what of it is in the derivative by ln L; ∂a = x a, ∂b = −x a/R)

    C = E S x̃ = (x a/R b σ_e² − x a (1 − κ) F P_e)/(1 − F²),   P_e = b² σ_e²/(1 − F²)

and L comes out too large by δ ln L = C/s over what a sample tells of ln L; s is the innovation's variance.

A winding that settles between samples answers to changes of the voltage, each of which is off by q²/6 (two roundings).
Where the changes Δv are not large against q, the share s = (q²/6)/E Δv² of their power is rounding that the current
does not follow. The response 1 − exp(−x) that is seen of a change is too small by s: δ ln L = s (exp(x) − 1)/x. As that
grows faster than L falls, it is evaluated at an L that is smaller by as much.

Parameters that the filter's covariance couples to L are biased with it (`along`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from servo_daemon.samples import F64

#: Averaging lengths: of the changes, ticks; of the information, calls of `learned` (about one a second). Chosen; not
#: tried.
_TICKS, _LOOKS = 50.0, 30.0
#: The changes are those within the winding's time; they are averaged anew once it is another by this factor (chosen;
#: not tried).
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
        self._information, self._looks = 0.0, 0.0  # a sample's on ln L, mean over so many calls of `learned`

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

    def learned(self, information: float) -> None:
        """Take the Fisher information on ln L of a sample of the last window. It is averaged, because the bias of L was
        learned over longer than a window, in motion and at rest."""
        self._looks = min(self._looks + 1.0, _LOOKS)
        self._information += (information - self._information) / self._looks

    def inductance_std(self, period_s: float, value: Mapping[str, float], noise: tuple[float, float] | None) -> float:
        """1 σ of ln L: the larger of both limits.

        Args:
            value: of R and L, natural units, as estimated.
            noise: variances that the filter takes the current's sensor, A², and the held voltage, V², to have; None:
                no current is measured.
        """
        if self.lsb_V == 0.0 or self._ticks == 0.0:
            return 0.0
        periods = min(period_s * value["R"] / value["L"], _MOST_PERIODS)
        share = self.lsb_V**2 / 6.0 / max(self._change_square, self.lsb_V**2 / 6.0)
        seen = min(share * _lost_of_change(periods), _MOST_STD)
        fast = share * _lost_of_change(min(periods * math.exp(seen), _MOST_PERIODS))
        slow = 0.0
        if noise is not None and self._information > 0.0:
            slow = _score(periods, value["R"], self.lsb_V**2 / 12.0, *noise) / self._information
        return min(max(fast, slow), _MOST_STD)


def _lost_of_change(periods: float) -> float:
    """δ ln L over the share of the changes' power that is rounding."""
    return math.expm1(periods) / max(periods, 1e-9)


def _score(x: float, R: float, rounding_V2: float, sensor_A2: float, input_V2: float) -> float:
    """C/s of the first limit."""
    a, b = math.exp(-x), -math.expm1(-x) / R
    driven, r = b**2 * input_V2, sensor_A2
    half = driven - r * (1.0 - a**2)
    s = r + 0.5 * (half + math.sqrt(half**2 + 4.0 * driven * r))  # of the filter in its steady state
    keeps = r / s  # 1 − κ
    F = a * keeps
    P_e = b**2 * rounding_V2 / (1.0 - F**2)
    C = x * a * (b / R * rounding_V2 - keeps * F * P_e) / (1.0 - F**2)
    return C / s


def along(covariance: F64, k: int, std: float) -> F64:
    """1 σ of all coordinates if coordinate k is off by `std` and the others follow it, shape (n,).

    Args:
        covariance: of the coordinates, shape (n, n).
    """
    return np.asarray(np.abs(covariance[:, k]) * (std / max(float(covariance[k, k]), 1e-300)))
