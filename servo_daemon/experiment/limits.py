"""What the drive may be asked to do: the configured limits, and defaults from the motor where one is missing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from servo_daemon.errors import BadInputError

#: Of the stall current: what a motor of which no limit is known is asked for.
_STALL_SHARE = 0.2
#: Of the greatest current: what heats the winding no more than it stands for a while.
_RMS_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class Limits:
    """Greatest voltage, current, speed (V, A, rad/s), distance from the start (rad; inf: turns freely), and RMS of the
    current over any block of a plan (A)."""

    voltage_V: float
    current_A: float
    velocity_rad_s: float
    travel_rad: float
    current_rms_A: float


@dataclass(frozen=True, slots=True)
class Peaks:
    """What a motion reaches: greatest moduli, and the current's RMS."""

    voltage_V: float
    current_A: float
    velocity_rad_s: float
    travel_rad: float
    current_rms_A: float

    def share(self, limits: Limits) -> float:
        """Of the limit that is nearest: 1 touches it."""
        return max(
            self.voltage_V / limits.voltage_V,
            self.current_A / limits.current_A,
            self.velocity_rad_s / limits.velocity_rad_s,
            self.travel_rad / limits.travel_rad,
            self.current_rms_A / limits.current_rms_A,
        )


def complete_limits(
    motor: Mapping[str, float],
    *,
    voltage_V: float | None = None,
    current_A: float | None = None,
    velocity_rad_s: float | None = None,
    travel_rad: float | None = None,
    current_rms_A: float | None = None,
) -> tuple[Limits, tuple[str, ...]]:
    """The limits, and for each that was not given what was taken instead and why.

    Args:
        motor: R, L, K, J, B.

    Raises:
        BadInputError: neither voltage nor current nor speed is limited: nothing says how strong the drive is.
    """
    R, K, B = motor["R"], motor["K"], motor["B"]
    notes = []
    if voltage_V is None:
        voltage_V, why = _voltage(motor, current_A, velocity_rad_s)
        notes.append(f"no voltage_V in [drive.limits]: {voltage_V:.4g} V, {why}")
    if current_A is None:
        current_A = _STALL_SHARE * voltage_V / R
        notes.append(
            f"no current_A in [drive.limits]: {current_A:.4g} A, {100 * _STALL_SHARE:g} % of the stall current"
        )
    if velocity_rad_s is None:
        velocity_rad_s = voltage_V * K / (R * B + K * K)
        notes.append(f"no velocity_rad_s in [drive.limits]: {velocity_rad_s:.4g} rad/s, the speed without load")
    if travel_rad is None:
        notes.append("no travel_rad in [drive.limits]: the shaft is taken to turn freely")
    if current_rms_A is None:
        current_rms_A = _RMS_SHARE * current_A
        notes.append(
            f"RMS current: at most {current_rms_A:.4g} A, {100 * _RMS_SHARE:g} % of current_A (--rms-current sets it)"
        )
    travel = math.inf if travel_rad is None else travel_rad
    return Limits(voltage_V, current_A, velocity_rad_s, travel, current_rms_A), tuple(notes)


def _voltage(motor: Mapping[str, float], current_A: float | None, velocity_rad_s: float | None) -> tuple[float, str]:
    """What speed or current take, and why it is that.

    Raises:
        BadInputError: none of the two is known.
    """
    R, K, B = motor["R"], motor["K"], motor["B"]
    if velocity_rad_s is not None:
        return velocity_rad_s * (K + R * B / K), "what the greatest speed takes"
    if current_A is not None:
        return R * current_A / _STALL_SHARE, f"{1 / _STALL_SHARE:g} times what the current takes at rest"
    raise BadInputError(
        "the drive's limits are not known: give voltage_V (or current_A or velocity_rad_s) in [drive.limits]"
    )
