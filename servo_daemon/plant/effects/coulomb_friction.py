"""Coulomb friction: a torque of constant size against the motion."""

from __future__ import annotations

from servo_daemon.parameters import Parameter
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
    ladder=10,
)
