"""Offset of the voltage: the recorded voltage is a constant too high."""

from __future__ import annotations

from servo_daemon.parameters import Parameter
from servo_daemon.plant.columns.regressors import Regressors, constant
from servo_daemon.plant.effects.base import Effect, Signals, Terms

V0 = Parameter(
    "v0",
    "v_0",
    "V",
    0.0,
    -10000.0,
    10000.0,
    "identity",
    "recorded voltage without a voltage at the motor",
    "start value",
)


def _terms(s: Signals) -> Terms:
    return Terms(voltage_drop=s.p["v0"])


EFFECT = Effect(
    name="voltage_sensor_offset",
    cause="The voltage's sensor has a zero error or the output stage an offset of its own; an offset of the current "
    "sensor together with a constant load torque leaves the same trace.",
    equation=r"v_{\mathrm{shown}} = v + v_0",
    parameters=(V0,),
    terms=_terms,
    regressors=Regressors(armature=(constant(V0),)),
    ladder=150,
)
