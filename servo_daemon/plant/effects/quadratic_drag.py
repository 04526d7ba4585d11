"""Quadratic drag: a fan, a pump or windage."""

from __future__ import annotations

import casadi as ca
import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import Regressors, itself
from servo_daemon.plant.effects.base import Effect, Signals, Terms

C2 = Parameter(
    "c2",
    "c_2",
    "N·m·s²/rad²",
    0.01,
    1e-12,
    1000.0,
    "log",
    "drag torque over the square of the speed",
    "start value",
    scale=Scale(0.05, torque=1, speed=-2),
)


def _terms(s: Signals) -> Terms:
    # A share of B and no torque on top: the core stays stable however strong it is.
    return Terms(viscous=s.p["c2"] * ca.fabs(s.omega))


EFFECT = Effect(
    name="quadratic_drag",
    cause="A fan, a pump or windage: turbulent flow resists with the square of the speed.",
    equation=r"c_2\,\omega\,|\omega|",
    parameters=(C2,),
    terms=_terms,
    regressors=Regressors(shaft=(itself(C2),), signals=lambda c, _: [c.speed * np.abs(c.speed)]),
    ladder=60,
)
