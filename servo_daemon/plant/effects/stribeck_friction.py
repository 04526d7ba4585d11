"""Stribeck friction: dry friction that is higher at creeping speed than when sliding."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import Column, Course, Regressors, Values, itself
from servo_daemon.plant.columns.screening import Basis, Context, positive
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.plant.effects.coulomb_friction import TC
from servo_daemon.samples import F64

TS = Parameter(
    "Ts",
    "T_s",
    "N·m",
    0.03,
    1e-09,
    10000.0,
    "log",
    "friction torque at rest, at which it breaks away",
    "start value",
    scale=Scale(0.08, torque=1),
)
WS = Parameter(
    "ws",
    r"\omega_s",
    "rad/s",
    0.4,
    1e-06,
    10000.0,
    "log",
    "Stribeck speed: where the excess has fallen to 37 %",
    "start value",
    scale=Scale(0.03, speed=1),
)

#: Least friction at the first step out of rest, over that at speed: a curve that bends otherwise, with less friction at
#: rest, is something else that fits it (a brake by eddy currents).
_AT_REST = 0.95

#: Stribeck speeds as shares of the usual speed.
_STRIBECK = np.geomspace(0.005, 0.6, 9)


def _terms(s: Signals) -> Terms:
    level = s.p["Tc"] + (s.p["Ts"] - s.p["Tc"]) * ca.exp(-((s.omega / s.p["ws"]) ** 2))
    return Terms(dry_friction=level)


#: The excess at rest over Tc.
BOUNDARY = Column(
    "boundary",
    TS.name,
    lambda value: (value["Ts"] - value["Tc"], {"Ts": value["Ts"], "Tc": -value["Tc"]}),
    lambda value: (value["boundary"] + value["Tc"], {"boundary": 1.0, "Tc": 1.0}),
)


def _signals(c: Course, value: Values) -> list[F64]:
    return [c.sliding, c.sliding * np.exp(-np.square(c.speed / value["ws"]))]


def _screening(c: Context) -> Iterator[Basis]:
    usual, Tc = float(np.percentile(np.abs(c.motion.omega), 95.0)), c.motion.p.get("Tc", 0.0)
    for ws in _STRIBECK * usual:

        def start(b: F64, ws: float = float(ws)) -> dict[str, float] | None:
            return {"Tc": Tc + b[0], "Ts": Tc + b[0] + b[1], "ws": ws} if positive(Tc + b[0], b[1]) else None

        bump = c.rest_friction * np.exp(-((c.motion.omega / ws) ** 2))
        yield Basis((c.torque("sgn", c.rest_friction), c.torque(f"bump {ws}", bump)), start, 3)


EFFECT = Effect(
    name="stribeck_friction",
    cause="A boundary-lubricated bearing, screw or gear holds harder at rest than it rubs once grease carries it.",
    equation=r"\left(T_c + (T_s - T_c)\,e^{-(\omega/\omega_s)^2}\right)\operatorname{sgn}\omega",
    parameters=(TC, TS, WS),
    terms=_terms,
    screening=_screening,
    regressors=Regressors(shaft=(itself(TC), BOUNDARY), signals=_signals),
    kind="friction",
    true_to_name=lambda value: value["Ts"] >= _AT_REST * value["Tc"],
    ladder=30,
    simpler=(("coulomb_friction",),),
    alike={"Ts": "Tc"},
    substeps=4,
)
