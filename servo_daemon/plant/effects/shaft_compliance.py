"""Shaft compliance: the load hangs on a spring."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.screening import Basis, Context, positive
from servo_daemon.plant.effects.base import TWIST, Effect, Shaft, Signals, Terms
from servo_daemon.samples import F64

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

#: Springs' frequencies that are tried, with the motor held, Hz, and damping.
_FREQUENCIES_HZ, _DAMPING = np.geomspace(4.0, 120.0, 10), (0.05, 0.3)


def _terms(s: Signals) -> Terms:
    return Terms(shaft=Shaft(s.p["J_l"], s.p["k_s"], s.p["c_s"]))


def _screening(c: Context) -> Iterator[Basis]:
    from scipy.signal import lfilter

    m = c.motion
    period = float(np.median(m.h))
    for f in [f for f in _FREQUENCIES_HZ.tolist() if f < 0.15 / period]:
        for zeta in _DAMPING:
            w, c2 = 2 * np.pi * f, 2 / period
            # (2ζws + w²)/(s² + 2ζws + w²) − 1 = −s²/(…) by Tustin's rule
            A = np.array([c2**2 + 2 * zeta * w * c2 + w**2, 2 * w**2 - 2 * c2**2, c2**2 - 2 * zeta * w * c2 + w**2])
            pulled = lfilter(-(c2**2) * np.array([1.0, -2.0, 1.0]) / A[0], A / A[0], m.omega_rate)

            def start(b: F64, w: float = w, zeta: float = zeta) -> dict[str, float] | None:
                if not positive(b[0]):
                    return None
                J_l = min(b[0], 0.9 * m.p["J"])
                return {"k_s": J_l * w**2, "c_s": 2 * zeta * w * J_l, "J_l": J_l}

            yield Basis((c.torque(f"spring {f} {zeta}", pulled),), start, 3)


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
    screening=_screening,
    ladder=250,
    told_from={
        "backlash": "small motions under a constant load, then about zero torque: a gap shows only where the sign "
        "changes.",
    },
    states=TWIST,
)
