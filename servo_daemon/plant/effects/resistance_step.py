"""Resistance step: from one instant on the armature circuit has another resistance."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.columns.scans import step_times
from servo_daemon.plant.columns.screening import Basis, Context
from servo_daemon.plant.effects.base import Effect, Signals, Terms, share_after
from servo_daemon.samples import F64

#: Whatever the step, this share of the resistance is left.
_LEAST = 1e-3

DR = Parameter(
    "dR",
    r"\Delta R",
    "Ω",
    0.0,
    -10000.0,
    10000.0,
    "identity",
    "change of the resistance at t_R",
    "start value",
    scale=Scale(0.0, R=1),
)
T_R = Parameter(
    "t_R",
    "t_R",
    "s",
    0.0,
    0.0,
    1000000000.0,
    "identity",
    "when it changes, counted from the first sample",
    "start value",
    scale=Scale(0.5, seconds=1),
    held="live",
)


def _terms(s: Signals) -> Terms:
    factor = 1 + s.p["dR"] / s.p["R"] * share_after(s.t, s.h, s.p["t_R"])
    return Terms(factor_R=ca.fmax(factor, _LEAST))


def _screening(c: Context) -> Iterator[Basis]:
    m = c.motion
    if "voltage" not in c.residual:
        return
    for k in step_times(c.residual["voltage"], m.i):

        def start(b: F64, at: float = float(m.t[k])) -> dict[str, float]:
            return {"dR": b[0], "t_R": at}

        yield Basis((c.voltage(f"step i {k}", np.where(m.t >= m.t[k], m.i, 0.0)),), start, 2)


EFFECT = Effect(
    name="resistance_step",
    cause="A connector, cable or brush got better or worse at one instant: a bad contact and a change of the winding "
    "itself (a shorted turn) leave the same trace here.",
    equation=r"R + \Delta R \quad (t \ge t_R)",
    parameters=(DR, T_R),
    terms=_terms,
    screening=_screening,
    regressors=NO_COLUMNS,
    kind="event",
    share_of={DR.name: "R"},
    ladder=180,
)
