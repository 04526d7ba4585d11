"""Asymmetric friction: Coulomb and viscous friction that differ by direction."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import casadi as ca
import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import Course, Regressors, Values, itself
from servo_daemon.plant.columns.screening import Basis, Context, positive
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.plant.effects.coulomb_friction import TC
from servo_daemon.samples import F64

TC_NEG = Parameter(
    "Tc_neg",
    "T_c^-",
    "N·m",
    0.02,
    1e-9,
    1e4,
    "log",
    "Coulomb friction torque in negative direction",
    "start value: that of Tc",
)
B_NEG = Parameter(
    "B_neg",
    "B^-",
    "N·m·s/rad",
    0.51141,
    1e-10,
    1e3,
    "log",
    "viscous friction in negative direction",
    "start value: the paper's motor's B",
    scale=Scale(1.0, B=1),
)


def _terms(s: Signals) -> Terms:
    return Terms(
        dry_friction=s.p["Tc"],
        dry_friction_neg=s.p["Tc_neg"],
        # A factor on B and no torque on top: the core stays exact in either direction, however stiff B_neg is.
        factor_B=ca.if_else(s.omega < 0, s.p["B_neg"] / s.p["B"], 1.0),
    )


def _signals(c: Course, _: Values) -> list[F64]:
    return [np.maximum(c.sliding, 0.0), np.minimum(c.sliding, 0.0), np.minimum(c.speed, 0.0)]


def _as_simpler(value: Values, instead: Sequence[str]) -> Values | None:
    mean, half = (value["Tc"] + value["Tc_neg"]) / 2, (value["Tc"] - value["Tc_neg"]) / 2
    if "constant_load_torque" not in instead:
        return {"Tc": mean}
    return {"Tc": mean, "TL": half}


def _screening(c: Context) -> Iterator[Basis]:
    m, Tc = c.motion, c.motion.p.get("Tc", 0.0)
    columns = (
        c.torque("forward", np.maximum(c.rest_friction, 0.0)),
        c.torque("backward", np.minimum(c.rest_friction, 0.0)),
        c.torque("omega backward", np.minimum(m.omega, 0.0)),
    )

    def start(b: F64) -> dict[str, float] | None:
        B_neg = m.p["B"] + b[2]
        if not positive(Tc + b[0], Tc + b[1]):
            return None
        return {"Tc": Tc + b[0], "Tc_neg": Tc + b[1], "B_neg": max(B_neg, 1e-3 * m.p["B"])}

    yield Basis(columns, start, 3)


EFFECT = Effect(
    name="asymmetric_friction",
    cause="A worn screw or gear rubs harder in one direction: Coulomb and viscous friction differ by direction.",
    equation=r"T_c + B\omega \ (\omega > 0), \quad -T_c^- + B^-\omega \ (\omega < 0)",
    parameters=(TC, TC_NEG, B_NEG),
    terms=_terms,
    screening=_screening,
    regressors=Regressors(shaft=(itself(TC), itself(TC_NEG), itself(B_NEG)), signals=_signals),
    kind="friction",
    as_simpler=_as_simpler,
    ladder=20,
    simpler=(("coulomb_friction",), ("coulomb_friction", "constant_load_torque")),
    alike={"Tc_neg": "Tc", "B_neg": "B"},
    told_from={
        "constant_load_torque": "turn the axis round, or take the load off: a load keeps its direction in space, "
        "friction that of motion."
    },
)
