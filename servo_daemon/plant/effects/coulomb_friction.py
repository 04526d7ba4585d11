"""Coulomb friction: a torque of constant size against the motion."""

from __future__ import annotations

from servo_daemon.parameters import Parameter
from servo_daemon.plant.columns.regressors import Regressors, itself
from servo_daemon.plant.effects.base import Effect, Signals, Terms

TC = Parameter(
    "Tc",
    "T_c",
    "N·m",
    0.02,
    1e-9,
    1e4,
    "log",
    "Coulomb friction torque",
    "start value: 1 % of the paper's motor's torque at 6 A",
)


def _terms(s: Signals) -> Terms:
    return Terms(dry_friction=s.p["Tc"])


EFFECT = Effect(
    name="coulomb_friction",
    cause="Dry friction in bearings, brushes or gears: a torque of constant size against the motion.",
    equation=r"T_c \operatorname{sgn}\omega",
    parameters=(TC,),
    terms=_terms,
    regressors=Regressors(shaft=(itself(TC),), signals=lambda c, _: [c.sliding]),
    kind="friction",
    ladder=10,
    told_from={
        "brush_voltage_drop": "lock the shaft and step the voltage: friction leaves no trace then, a brush drop its "
        "volts. Or record the current: friction raises it, a brush drop does not.",
        "load_dependent_friction": "slow reversals through standstill, a few seconds each way, once idle and once "
        "with a second load: load friction grows with it, Coulomb does not.",
        "stribeck_friction": "slow reversals through standstill, a few seconds each way, so slow that the axis "
        "sticks: only Stribeck friction falls as it starts to slide.",
        "quadratic_drag": "hold several constant speeds up to the highest: drag grows with the square of the speed, "
        "Coulomb stays.",
        "backlash": "let it reverse without load and watch the angle: in a gap the motor turns freely, in friction "
        "it stands.",
    },
)
