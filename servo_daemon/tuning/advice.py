"""What linear theory does not say of a loop: the voltage's limit, the encoder's steps, dry friction, gravity."""

from __future__ import annotations

import math
from dataclasses import dataclass

from servo_daemon.tuning.knowledge import CascadeGains, LoopSetup, MotorKnowledge
from servo_daemon.tuning.laws import Gains, StateGains, smoothing
from servo_daemon.tuning.response import Response

#: Worth a remark: ripple of the voltage from one encoder count, over the supply; gravity over the loop's stiffness.
_RIPPLE_SHARE, _GRAVITY_SHARE = 0.02, 0.1
#: Effects whose part in these loops is stated, or that have none.
_UNDERSTOOD = ("coulomb_friction", "constant_load_torque", "gravity_load", "winding_heating", "current_sensor_offset")


@dataclass(frozen=True, slots=True)
class Advice:
    """None: what it needs is not known, or it does not apply.

    Attributes:
        largest_step: of the reference that the voltage's limit lets be linear, rad/s or rad.
        ripple_V: jump of the voltage when the encoder moves on by one count.
        breakaway_V: voltage that dry friction takes before the shaft moves.
        notes: in words.
    """

    largest_step: float | None
    ripple_V: float | None
    breakaway_V: float | None
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Stiffness:
    """What a standing error does at once (V/rad) and in time (V/(rad·s))."""

    proportional: float
    integral: float


def advise(gains: Gains, answer: Response | None, motor: MotorKnowledge, setup: LoopSetup) -> Advice:
    """Everything that applies to these gains."""
    position = _stiffness(gains)
    ripple = _ripple_V(gains, setup)
    breakaway = _breakaway_V(motor)
    largest = None if setup.voltage_V is None or answer is None else setup.voltage_V / answer.peak_V
    notes = [
        *_voltage_notes(largest, ripple, position is not None, setup),
        *_friction_notes(breakaway, position, gains, setup),
        *_gravity_notes(position, motor),
    ]
    if isinstance(gains, StateGains):
        notes.append("needs a measured current; without that sensor use the position loop")
    if other := [name for name in motor.effects if name not in _UNDERSTOOD]:
        notes.append(f"not in these margins: {', '.join(other)}")
    return Advice(largest, ripple, breakaway, tuple(notes))


def _stiffness(gains: Gains) -> _Stiffness | None:
    """Stiffness of a position loop; None for a speed loop."""
    if isinstance(gains, StateGains):
        return _Stiffness(gains.angle_V_rad, gains.integral_V_rad_s)
    if gains.position_kp_1_s is None:
        return None
    b, kp, ki = gains.setpoint_weight, gains.speed_kp_V_s_rad, gains.speed_ki_V_rad
    return _Stiffness(b * kp * gains.position_kp_1_s + ki, ki * gains.position_kp_1_s + b * kp * gains.position_ki_1_s2)


def _ripple_V(gains: Gains, setup: LoopSetup) -> float | None:
    """One count: the difference shows it as one count per sample, the filter lets 1 − α of that pass."""
    if setup.counts_per_rev is None:
        return None
    count = 2.0 * math.pi / setup.counts_per_rev
    passed = 1.0 - smoothing(gains.filter_hz, setup.period_s)
    speed_gain = (
        gains.speed_V_s_rad
        if isinstance(gains, StateGains)
        else (gains.speed_kp_V_s_rad + gains.speed_ki_V_rad * setup.period_s)
        * (1.0 + gains.setpoint_weight * gains.position_kd)
    )
    return abs(speed_gain) * passed * count / setup.period_s


def _breakaway_V(motor: MotorKnowledge) -> float | None:
    """R Tc / K: at rest the voltage is R i, and K i has to exceed the friction torque."""
    if "coulomb_friction" not in motor.effects or "Tc" not in motor.extras:
        return None
    return motor.parameters["R"].value * motor.extras["Tc"] / motor.parameters["K"].value


def _voltage_notes(largest: float | None, ripple: float | None, position: bool, setup: LoopSetup) -> list[str]:
    notes = []
    unit = "rad" if position else "rad/s"
    if largest is not None:
        notes.append(
            f"linear up to steps of {largest:.3g} {unit}: larger ones meet the limit of {setup.voltage_V:g} V and take "
            "longer; stop the integrals meanwhile, or limit the reference's slope"
        )
    if ripple is not None and setup.voltage_V is not None and ripple > _RIPPLE_SHARE * setup.voltage_V:
        notes.append(
            f"one encoder count moves the voltage by {ripple:.3g} V: a lower bandwidth or speed filter is quieter"
        )
    return notes


def _friction_notes(breakaway: float | None, position: _Stiffness | None, gains: Gains, setup: LoopSetup) -> list[str]:
    if breakaway is None:
        return []
    if position is None:
        ki = gains.speed_ki_V_rad if isinstance(gains, CascadeGains) else 0.0
        tail = "" if ki > 0 else "; without k_i it also keeps a speed error"
        return [f"dry friction: each reversal costs the loop a jump of {2 * breakaway:.3g} V{tail}"]
    if position.integral == 0:
        error = breakaway / position.proportional
        return [f"dry friction: it may stop up to {error:.3g} rad off the wanted angle"]
    text = "dry friction and integral action: it stops a little off, waits for the integral, and creeps there or hunts"
    if setup.counts_per_rev is not None:
        count = 2.0 * math.pi / setup.counts_per_rev
        wait = 2.0 * breakaway / (position.integral * count)
        text += f"; from one encoder count off, a hunting swing takes {wait:.3g} s"
    return [f"{text}. Stop the integral inside a small band (or add the sign of the wanted speed × {breakaway:.3g} V)"]


def _gravity_notes(position: _Stiffness | None, motor: MotorKnowledge) -> list[str]:
    if "gravity_load" not in motor.effects or position is None or "Tg" not in motor.extras:
        return []
    stiffness = motor.parameters["K"].value * position.proportional / motor.parameters["R"].value
    share = motor.extras["Tg"] / stiffness
    if share < _GRAVITY_SHARE:
        return []
    return [
        f"gravity's own stiffness is up to {100 * share:.0f} % of the loop's and not in these margins: the loop is "
        "softer on one side of the turn and stiffer on the other"
    ]
