"""The voltages that even a motor that is stopped at once can take without more than the greatest current."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

#: Of the greatest current: what is left is for the uncertainty of a first fit and for noise.
_SHARE = 0.85
#: A shaft that runs against something comes back with at most this share of its speed (steel on steel with losses in
#: gear and bearings: below 0.5).
_REBOUND = 0.5


@dataclass(frozen=True, slots=True)
class Envelope:
    """Ω, V·s/rad, V, A.

    Attributes:
        R, K: of the last fit.
        voltage_V, current_A: limits.
    """

    R: float
    K: float
    voltage_V: float
    current_A: float

    @classmethod
    def of(cls, motor: Mapping[str, float], voltage_V: float, current_A: float) -> Envelope:
        """The envelope of a motor with fitted parameters."""
        return cls(motor["R"], motor["K"], voltage_V, current_A)

    @property
    def reach_V(self) -> float:
        """Greatest voltage at rest."""
        return _SHARE * self.R * self.current_A

    def clamp(self, wanted_V: float, speed_rad_s: float) -> float:
        """The nearest voltage that is allowed at this speed: the current stays below its limit if the motor turns on,
        stands, or has turned round."""
        emf = self.K * speed_rad_s
        reach = self.reach_V
        low = max(emf, 0.0, -_REBOUND * emf) - reach
        high = min(emf, 0.0, -_REBOUND * emf) + reach
        low, high = max(low, -self.voltage_V), min(high, self.voltage_V)
        if low > high:  # too fast for any: braking by 0 V is the gentlest
            return 0.0
        return min(max(wanted_V, low), high)
