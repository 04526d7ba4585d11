"""Load torque step: from one instant on a constant load more."""

from __future__ import annotations

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.effects.base import Effect, Signals, Terms, share_after
from servo_daemon.plant.regressors import NO_COLUMNS

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


EFFECT = Effect(
    name="load_torque_step",
    cause="Something was put on, clamped or let go during the recording: from one instant on the load is another.",
    equation=r"\Delta T_L \quad (t \ge t_{T_L})",
    parameters=(
        DTL,
        T_TL,
    ),
    terms=_terms,
    regressors=NO_COLUMNS,
    kind="event",
    as_simpler=lambda value, instead: {"TL": value["dTL"]} if "constant_load_torque" in instead else {},
    ladder=90,
    simpler=(("constant_load_torque",),),
)
