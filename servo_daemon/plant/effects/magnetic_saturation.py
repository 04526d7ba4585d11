"""Magnetic saturation: the torque constant falls at high current."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.columns.screening import Basis, Context, Trace, positive
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.samples import F64

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

#: Knees that are tried, in shares of the greatest current.
_KNEES = (0.7, 1.2, 2.0, 4.0)


def _terms(s: Signals) -> Terms:
    return Terms(factor_K=1 / (1 + (s.i / s.p["I_sat"]) ** 2))


def _screening(c: Context) -> Iterator[Basis]:
    m = c.motion
    if "K" not in m.p:
        return
    for knee in np.array(_KNEES) * float(np.max(np.abs(m.i))):

        def start(b: F64, knee: float = float(knee)) -> dict[str, float] | None:
            # A motor that loses more than half of its torque is none; without a bound any torque is "lost".
            if not positive(b[0]) or knee / float(np.sqrt(b[0])) < float(np.max(np.abs(m.i))):
                return None
            return {"I_sat": knee / float(np.sqrt(b[0]))}

        lost = 1 - 1 / (1 + (m.i / knee) ** 2)
        trace = Trace(torque=m.p["K"] * m.i * lost, voltage=-m.p["K"] * m.omega * lost)
        yield Basis((c.add(f"knee {knee}", trace),), start, 1)


EFFECT = Effect(
    name="magnetic_saturation",
    cause="At high current the armature's field saturates the iron and weakens the magnets: less torque an ampere.",
    equation=r"K / (1 + (i/I_{sat})^2)",
    parameters=(I_SAT,),
    terms=_terms,
    screening=_screening,
    regressors=NO_COLUMNS,
    ladder=190,
    substeps=4,
)
