"""Offset of the current sensor: it shows a constant too much."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.parameters import Parameter
from servo_daemon.plant.columns.regressors import Regressors, constant
from servo_daemon.plant.columns.screening import Basis, Context, Trace
from servo_daemon.plant.effects.base import Effect, Signals, Terms

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


def _screening(c: Context) -> Iterator[Basis]:
    one = np.ones(len(c.motion.t))
    trace = Trace(shown={"current_A": one}) if "L" in c.motion.p else Trace(torque=c.motion.p["K"] * one)
    yield Basis((c.add("i0", trace),), lambda b: {"i0": b[0]}, 1)


EFFECT = Effect(
    name="current_sensor_offset",
    cause="The current sensor's amplifier or converter has a zero error: it shows a constant too much.",
    equation=r"i_{\mathrm{shown}} = i + i_0",
    parameters=(I0,),
    terms=_terms,
    screening=_screening,
    regressors=Regressors(armature=(constant(I0, lambda value: -value["R"]),)),
    ladder=130,
    told_from={
        "voltage_sensor_offset": "record a few seconds with the drive off: each sensor shows its own offset then.",
    },
)
