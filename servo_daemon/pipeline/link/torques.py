"""What a moment of the current or torque of a drive under control is worth, where it drives the filter's motion."""

from __future__ import annotations

from servo_daemon.plant.effects import parameter_table

#: What the filter's motion is exact to beside its own noise, 1 σ of J, B and every torque: a current runs on between
#: two samples, and one of them may come a tenth of a period late. Measured on the independent plant of
#: tests/recovery/foc (two motors, two motions, 50 to 1000 Hz): 0.3 % and a hundredth for every 20 ms of the period.
_MOTION, _MOTION_PER_S = 3e-3, 0.01 / 0.02


def motion_std(period_s: float) -> float:
    """1 σ of every torque, a share of it.

    Args:
        period_s: from one sample to the next.
    """
    return _MOTION + _MOTION_PER_S * period_s


def is_torque(name: str) -> bool:
    """Whether a parameter goes with K where the current drives the motion: torques, inertias, springs."""
    p = parameter_table().get(name)
    return name == "J_d" or (p is not None and p.unit.startswith(("N", "kg")))
