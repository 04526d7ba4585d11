"""Constant load torque: a hanging weight on a drum, a spring far from its rest, a biased process."""

from __future__ import annotations

import numpy as np

from servo_daemon.parameters import Parameter
from servo_daemon.plant.columns.regressors import Regressors, constant
from servo_daemon.plant.effects.base import Effect, Signals, Terms

TL = Parameter(
    "TL",
    "T_L",
    "N·m",
    0.0,
    -1e4,
    1e4,
    "identity",
    "constant load torque, positive against positive motion",
    "start value",
)


def _terms(s: Signals) -> Terms:
    return Terms(load_torque=s.p["TL"])


EFFECT = Effect(
    name="constant_load_torque",
    cause="A load that pulls in one direction whatever the motion, such as a weight on a drum.",
    equation=r"T_L",
    parameters=(TL,),
    terms=_terms,
    regressors=Regressors(shaft=(constant(TL),), signals=lambda c, _: [np.ones_like(c.time_s)]),
    ladder=70,
    told_from={
        "current_sensor_offset": "record a few seconds with the drive off: what the current sensor shows then is its "
        "offset.",
        "voltage_sensor_offset": "record a few seconds with the output shorted or off: what is shown then is an "
        "offset, not a load.",
    },
)
