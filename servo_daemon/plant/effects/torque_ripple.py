"""Torque ripple: the torque constant varies with the angle."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import Course, Regressors, Values, sine_and_cosine, wave
from servo_daemon.plant.columns.scans import best_harmonics
from servo_daemon.plant.columns.screening import Basis, Context, Trace, phase
from servo_daemon.plant.effects.base import Effect, Signals, Terms, mean_sine, moment_of_sine
from servo_daemon.samples import F64

K_RIP = Parameter(
    "k_rip",
    "k_{rip}",
    "1",
    0.03,
    1e-06,
    0.9,
    "log",
    "relative amplitude of the torque constant's ripple",
    "start value",
    scale=Scale(0.05),
)
N_RIP = Parameter(
    "n_rip",
    "n_{rip}",
    "1",
    10.0,
    0.05,
    100000.0,
    "log",
    "periods of the ripple a turn (an integer on the motor's own shaft)",
    "start value",
    held="always",
)
PHI_RIP = Parameter(
    "phi_rip", r"\varphi_{rip}", "rad", 0.0, -6.5, 6.5, "identity", "phase of the ripple at angle zero", "start value"
)


def _terms(s: Signals) -> Terms:
    phase = s.p["n_rip"] * s.theta + s.p["phi_rip"]
    change = s.p["n_rip"] * s.omega * s.h
    return Terms(
        factor_K=1 + s.p["k_rip"] * mean_sine(phase, change),
        moment_K=s.p["k_rip"] * moment_of_sine(phase, change) * s.h,
    )


WAVE = wave("rip", K_RIP, PHI_RIP, share=True)


def _signals(c: Course, value: Values) -> list[F64]:
    return [-c.effort * x for x in sine_and_cosine(value["n_rip"] * c.angle)]


def _screening(c: Context) -> Iterator[Basis]:
    m = c.motion
    if "K" not in m.p or "torque" not in c.residual:
        return
    torque, emf = -m.p["K"] * m.i, m.p["K"] * m.omega
    for n in best_harmonics(c, torque):

        def start(b: F64, n: int = n) -> dict[str, float]:
            size, angle = phase(b[0], b[1])
            return {"k_rip": size, "n_rip": float(n), "phi_rip": angle}

        s, k = np.sin(n * m.theta), np.cos(n * m.theta)
        columns = (
            c.add(f"ripple sin {n}", Trace(torque=torque * s, voltage=emf * s)),
            c.add(f"ripple cos {n}", Trace(torque=torque * k, voltage=emf * k)),
        )
        yield Basis(columns, start, 3)


EFFECT = Effect(
    name="torque_ripple",
    cause="Few commutator bars, or windings and magnets that are not alike: the torque constant varies with the angle.",
    equation=r"K\,(1 + k_{rip}\sin(n_{rip}\theta + \varphi_{rip}))",
    parameters=(
        K_RIP,
        N_RIP,
        PHI_RIP,
    ),
    terms=_terms,
    screening=_screening,
    regressors=Regressors(shaft=WAVE, armature=WAVE, signals=_signals),
    phases={PHI_RIP.name: N_RIP.name},
    kind="angle",
    share_of={K_RIP.name: ""},
    ladder=120,
    told_from={
        "periodic_disturbance": "repeat it at another speed: ripple stays with the angle, a disturbance with the "
        "clock.",
    },
    substeps=4,
)
