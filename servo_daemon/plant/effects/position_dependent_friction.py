"""Position-dependent friction: the model's dry friction varies along the travel."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import Column, Course, Derived, Regressors, Values
from servo_daemon.plant.columns.screening import Basis, Context, positive
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.samples import F64

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


def _per_level(p: Parameter) -> Column:
    """A column whose coefficient is that times the level of Coulomb friction; another's is no single column."""

    def coefficient(value: Values) -> Derived:
        torque = value["Tc"] * value[p.name]
        return torque, {"Tc": torque, p.name: value["Tc"]}

    def solve(value: Values) -> Derived:
        torque, Tc = value[p.name], value["Tc"]
        return (torque, {p.name: 1.0}) if Tc == 0.0 else (torque / Tc, {p.name: 1.0 / Tc, "Tc": -torque / Tc**2})

    return Column(p.name, p.name, coefficient, solve)


def _signals(c: Course, _: Values) -> list[F64]:
    return [c.sliding * c.angle, c.sliding * c.angle * c.angle]


def _screening(c: Context) -> Iterator[Basis]:
    if "position_rad" not in c.channels:  # where a run begins along the travel nobody knows
        return
    theta, Tc = c.motion.theta, c.motion.p.get("Tc", 0.0)

    def start(b: F64) -> dict[str, float] | None:
        level = Tc + b[0]
        return {"Tc": level, "Tc_slope": b[1] / level, "Tc_curve": b[2] / level} if positive(level) else None

    columns = (
        c.torque("sgn", c.rest_friction),
        c.torque("theta sgn", c.rest_friction * theta),
        c.torque("theta² sgn", c.rest_friction * theta**2),
    )
    yield Basis(columns, start, 3)


EFFECT = Effect(
    name="position_dependent_friction",
    cause="A screw, guide or seal rubs harder in one part of its travel: preload, straightness or wear vary along it.",
    equation=r"\left(1 + a\,\theta + b\,\theta^2\right)\times\text{dry friction}",
    parameters=(
        TC_SLOPE,
        TC_CURVE,
    ),
    terms=_terms,
    screening=_screening,
    regressors=Regressors(
        shaft=(_per_level(TC_SLOPE), _per_level(TC_CURVE)), signals=_signals, beside="coulomb_friction"
    ),
    ladder=50,
    scales_friction=True,
)
