"""Offset of the current sensor: it shows a constant too much."""

from __future__ import annotations

from servo_daemon.parameters import Parameter
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.plant.regressors import Regressors, constant

I0 = Parameter(
    "i0",
    "i_0",
    "A",
    0.0,
    -1e3,
    1e3,
    "identity",
    "what the current sensor shows without a current",
    "start value",
)


def _terms(s: Signals) -> Terms:
    return Terms(sensed={"current_A": s.p["i0"]})


EFFECT = Effect(
    name="current_sensor_offset",
    cause="The current sensor's amplifier or converter has a zero error: it shows a constant too much.",
    equation=r"i_{\mathrm{shown}} = i + i_0",
    parameters=(I0,),
    terms=_terms,
    regressors=Regressors(armature=(constant(I0, lambda value: -value["R"]),)),
    ladder=130,
    told_from={
        "voltage_sensor_offset": "record a few seconds with the drive off: each sensor shows its own offset then.",
    },
)
