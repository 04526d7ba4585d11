"""Magnetic saturation: the torque constant falls at high current."""

from __future__ import annotations

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.plant.regressors import NO_COLUMNS

I_SAT = Parameter(
    "I_sat",
    "I_{sat}",
    "A",
    40.0,
    0.0001,
    1000000.0,
    "log",
    "current at which the torque constant has halved",
    "start value",
    scale=Scale(3.0, current=1),
)


def _terms(s: Signals) -> Terms:
    return Terms(factor_K=1 / (1 + (s.i / s.p["I_sat"]) ** 2))


EFFECT = Effect(
    name="magnetic_saturation",
    cause="At high current the armature's field saturates the iron and weakens the magnets: less torque an ampere.",
    equation=r"K / (1 + (i/I_{sat})^2)",
    parameters=(I_SAT,),
    terms=_terms,
    regressors=NO_COLUMNS,
    ladder=190,
    substeps=4,
)
