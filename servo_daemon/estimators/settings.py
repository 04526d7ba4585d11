"""What the estimators are told: resolutions of the drive, and what the user fixed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Resolutions:
    """Least significant bits, where they are known."""

    position_rad: float | None = None
    current_A: float | None = None
    voltage_V: float | None = None

    def of(self, name: str) -> float | None:
        return getattr(self, name, None)


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """What the user fixed.

    Attributes:
        effects: names of the effects in the model.
        nominal: given values by parameter, natural units.
        drift_per_sqrt_s: 1 σ of each coordinate's random walk, 1/√s; defaults where absent.
        engine: "compiled" or "filterpy".
    """

    effects: tuple[str, ...] = ()
    nominal: Mapping[str, float] | None = None
    drift_per_sqrt_s: Mapping[str, float] | None = None
    engine: str = "compiled"
