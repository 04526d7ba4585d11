"""What the motor may do while it is commissioned."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Greatest moduli: V, A, rad/s, rad from where the run began; °C of the drive's own sensor (None: not watched);
    seconds of motion altogether."""

    voltage_V: float
    current_A: float
    speed_rad_s: float
    travel_rad: float
    seconds: float
    temperature_C: float | None = None
