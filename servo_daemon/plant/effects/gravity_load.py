"""Gravity load: an unbalanced arm or pendulum on the shaft."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from servo_daemon.parameters import Parameter
from servo_daemon.plant.columns.regressors import Regressors, sine_and_cosine, wave
from servo_daemon.plant.columns.screening import Basis, Context, phase
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.samples import F64

TG = Parameter("Tg", "T_g", "N·m", 0.1, 1e-9, 1e4, "log", "greatest gravity torque, m g l", "start value")
PHI_G = Parameter(
    "phi_g",
    r"\varphi_g",
    "rad",
    0.0,
    -6.5,
    6.5,
    "identity",
    "angle of the arm's lowest point, negated",
    "start value",
)


def _terms(s: Signals) -> Terms:
    return Terms(load_torque=s.p["Tg"] * ca.sin(s.theta + s.p["phi_g"]))


def _screening(c: Context) -> Iterator[Basis]:
    def start(b: F64) -> dict[str, float]:
        size, angle = phase(b[0], b[1])
        return {"Tg": size, "phi_g": angle}

    theta = c.motion.theta
    yield Basis((c.torque("sin 1", np.sin(theta)), c.torque("cos 1", np.cos(theta))), start, 2)


EFFECT = Effect(
    name="gravity_load",
    cause="An unbalanced arm or pendulum on the shaft, pulled down by its weight.",
    equation=r"T_g \sin(\theta + \varphi_g)",
    parameters=(TG, PHI_G),
    terms=_terms,
    screening=_screening,
    regressors=Regressors(shaft=wave("grav", TG, PHI_G), signals=lambda c, _: sine_and_cosine(c.angle)),
    phases={PHI_G.name: ""},
    kind="angle",
    ladder=80,
    told_from={
        "encoder_eccentricity": "turn slowly by hand or hold several angles: gravity takes current to hold, an "
        "eccentric encoder none.",
        "cogging_torque": "turn slowly through whole revolutions: gravity comes once a turn, cogging as often as "
        "there are poles.",
    },
)
