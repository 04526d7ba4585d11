"""Position-dependent friction: the model's dry friction varies along the travel."""

from __future__ import annotations

import casadi as ca

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.effects.base import Effect, Signals, Terms

TC_SLOPE = Parameter(
    "Tc_slope",
    "a",
    "1/rad",
    0.0,
    -10000.0,
    10000.0,
    "identity",
    "relative rise of the dry friction with the angle, at angle zero",
    "start value",
    scale=Scale(0.0, travel=-1),
)
TC_CURVE = Parameter(
    "Tc_curve",
    "b",
    "1/rad²",
    0.0,
    -1000000.0,
    1000000.0,
    "identity",
    "its relative curvature",
    "start value",
    scale=Scale(0.0, travel=-2),
)


def _terms(s: Signals) -> Terms:
    factor = 1 + s.theta * (s.p["Tc_slope"] + s.p["Tc_curve"] * s.theta)
    return Terms(factor_dry=ca.fmax(factor, 0.0))


EFFECT = Effect(
    name="position_dependent_friction",
    cause="A screw, guide or seal rubs harder in one part of its travel: preload, straightness or wear vary along it.",
    equation=r"\left(1 + a\,\theta + b\,\theta^2\right)\times\text{dry friction}",
    parameters=(
        TC_SLOPE,
        TC_CURVE,
    ),
    terms=_terms,
    ladder=50,
    scales_friction=True,
)
