"""Backlash: the load follows through a gap."""

from __future__ import annotations

from servo_daemon.parameters import Parameter
from servo_daemon.plant.effects.base import TWIST, Effect, Shaft, Signals, Terms
from servo_daemon.plant.effects.shaft_compliance import C_S, J_L, K_S, SHAFT

GAP = Parameter(
    "gap", "g", "rad", 0.01, 1e-09, 10.0, "log", "whole free angle between the flanks", "start value", held="live"
)


def _terms(s: Signals) -> Terms:
    return Terms(shaft=Shaft(s.p["J_l"], s.p["k_s"], s.p["c_s"], s.p["gap"]))


EFFECT = Effect(
    name="backlash",
    cause="Worn gear teeth, a key or a claw coupling have play: the load follows only after the gap is crossed.",
    equation=r"J_l\dot\omega_l = k_s\left(\delta \mp \tfrac{g}{2}\right) + c_s\dot\delta \text{ where flanks press},"
    r"\ \delta = \theta - \theta_l",
    parameters=(
        GAP,
        K_S,
        C_S,
        J_L,
    ),
    terms=_terms,
    hides={K_S.name: SHAFT, J_L.name: SHAFT},
    # Within a gap the load is where no sensor sees it, and a filter that has taken it for pressed against the wrong
    # flank is sure of what it makes of that (k_s 96 % off at 300 std).
    never_sure={GAP.name: SHAFT},
    ladder=260,
    simpler=(("shaft_compliance",),),
    states=TWIST,
    substeps=2,
)
