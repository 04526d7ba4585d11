"""Periodic disturbance: a torque that follows time, not angle."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import Regressors, sine_and_cosine, wave
from servo_daemon.plant.columns.scans import spectral_lines
from servo_daemon.plant.columns.screening import Basis, Context, phase
from servo_daemon.plant.effects.base import Effect, Signals, Terms, mean_sine
from servo_daemon.samples import F64

TPER = Parameter(
    "Tper",
    "T_{per}",
    "N·m",
    0.02,
    1e-09,
    10000.0,
    "log",
    "amplitude of the periodic torque",
    "start value",
    scale=Scale(0.05, torque=1),
)
F_PER = Parameter("f_per", "f_{per}", "Hz", 10.0, 0.001, 100000.0, "log", "its frequency", "start value", held="live")
PHI_PER = Parameter(
    "phi_per", r"\varphi_{per}", "rad", 0.0, -6.5, 6.5, "identity", "its phase at the first sample", "start value"
)


def _terms(s: Signals) -> Terms:
    rate = 2 * math.pi * s.p["f_per"]
    phase = rate * s.t + s.p["phi_per"]
    return Terms(load_torque=s.p["Tper"] * mean_sine(phase, rate * s.h))


def _screening(c: Context) -> Iterator[Basis]:
    if "torque" not in c.residual:
        return
    t = c.motion.t
    for f in spectral_lines(t, c.residual["torque"], 2):

        def start(b: F64, f: float = f) -> dict[str, float]:
            size, angle = phase(b[0], b[1])
            return {"Tper": size, "f_per": f, "phi_per": angle}

        wave = 2 * np.pi * f * (t + c.motion.h / 2)
        yield Basis(
            (c.torque(f"sin f {f}", np.sin(wave)), c.torque(f"cos f {f}", np.cos(wave))),
            start,
            3,
        )


EFFECT = Effect(
    name="periodic_disturbance",
    cause="A neighbouring machine, a pump or a process shakes the load at a frequency of its own.",
    equation=r"T_{per}\sin(2\pi f_{per} t + \varphi_{per})",
    parameters=(
        TPER,
        F_PER,
        PHI_PER,
    ),
    terms=_terms,
    screening=_screening,
    regressors=Regressors(
        shaft=wave("per", TPER, PHI_PER),
        signals=lambda c, value: sine_and_cosine(2 * math.pi * value["f_per"] * c.time_s),
    ),
    ladder=100,
)
