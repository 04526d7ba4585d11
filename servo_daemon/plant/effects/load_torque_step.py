"""Load torque step: from one instant on a constant load more."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.columns.scans import step_times
from servo_daemon.plant.columns.screening import Basis, Context
from servo_daemon.plant.effects.base import Effect, Signals, Terms, share_after
from servo_daemon.samples import F64

DTL = Parameter(
    "dTL",
    r"\Delta T_L",
    "N·m",
    0.0,
    -10000.0,
    10000.0,
    "identity",
    "load torque from t_TL on, positive against positive motion",
    "start value",
)
T_TL = Parameter(
    "t_TL",
    "t_{T_L}",
    "s",
    0.0,
    0.0,
    1000000000.0,
    "identity",
    "when it begins, counted from the first sample",
    "start value",
    scale=Scale(0.5, seconds=1),
    held="live",
)


def _terms(s: Signals) -> Terms:
    return Terms(load_torque=s.p["dTL"] * share_after(s.t, s.h, s.p["t_TL"]))


def _screening(c: Context) -> Iterator[Basis]:
    if "torque" not in c.residual:
        return
    t = c.motion.t
    for k in step_times(c.residual["torque"], np.where(c.motion.rest, 0.0, 1.0)):

        def start(b: F64, at: float = float(t[k])) -> dict[str, float]:
            return {"dTL": b[0], "t_TL": at}

        yield Basis((c.torque(f"step {k}", (t >= t[k]).astype(float)),), start, 2)


EFFECT = Effect(
    name="load_torque_step",
    cause="Something was put on, clamped or let go during the recording: from one instant on the load is another.",
    equation=r"\Delta T_L \quad (t \ge t_{T_L})",
    parameters=(DTL, T_TL),
    terms=_terms,
    screening=_screening,
    regressors=NO_COLUMNS,
    kind="event",
    as_simpler=lambda value, instead: {"TL": value["dTL"]} if "constant_load_torque" in instead else {},
    ladder=90,
    simpler=(("constant_load_torque",),),
)
