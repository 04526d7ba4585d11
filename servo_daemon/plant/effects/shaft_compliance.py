"""Shaft compliance: the load hangs on a spring."""

from __future__ import annotations

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.effects.base import TWIST, Effect, Shaft, Signals, Terms

K_S = Parameter(
    "k_s",
    "k_s",
    "N·m/rad",
    100.0,
    1e-06,
    1000000000.0,
    "log",
    "stiffness of shaft, coupling or belt",
    "start value",
    scale=Scale(2e4, J=1),
)
C_S = Parameter(
    "c_s", "c_s", "N·m·s/rad", 0.1, 1e-10, 100000.0, "log", "its damping", "start value", scale=Scale(15.0, J=1)
)
J_L = Parameter(
    "J_l",
    "J_l",
    "kg·m²",
    0.005,
    1e-10,
    1000.0,
    "log",
    "inertia behind it; J is the motor's side alone",
    "start value",
    scale=Scale(0.3, J=1),
)

#: What a second inertia on a spring has to do with.
SHAFT = ("J", "B", K_S.name, C_S.name, J_L.name)


def _terms(s: Signals) -> Terms:
    return Terms(shaft=Shaft(s.p["J_l"], s.p["k_s"], s.p["c_s"]))


EFFECT = Effect(
    name="shaft_compliance",
    cause="A long shaft, a coupling, a belt or a harmonic drive gives way: the load swings behind the motor.",
    equation=r"J_l\dot\omega_l = k_s(\theta - \theta_l) + c_s(\omega - \omega_l) = \text{load torque of the motor}",
    parameters=(
        K_S,
        C_S,
        J_L,
    ),
    terms=_terms,
    hides={K_S.name: SHAFT, J_L.name: SHAFT},
    ladder=250,
    told_from={
        "backlash": "small motions under a constant load, then about zero torque: a gap shows only where the sign "
        "changes.",
    },
    states=TWIST,
)
