"""Cogging torque: slots and magnets attract each other; one harmonic, and up to three further ones beside it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import Regressors, sine_and_cosine, wave
from servo_daemon.plant.columns.scans import best_harmonics
from servo_daemon.plant.columns.screening import Basis, Context, phase
from servo_daemon.plant.effects.base import Effect, Signals, Terms, mean_sine
from servo_daemon.samples import F64

#: Endings of the harmonics' names: `cogging_torque_2` has `Tcog_2`, `n_cog_2` and `phi_cog_2`.
HARMONICS = ("", "_2", "_3", "_4")


def _parameters(ending: str) -> tuple[Parameter, Parameter, Parameter]:
    mark = ending.replace("_", ",")
    return (
        Parameter(
            f"Tcog{ending}",
            f"T_{{cog{mark}}}",
            "N·m",
            0.02,
            1e-9,
            1e4,
            "log",
            "amplitude of the cogging torque",
            "start value",
            scale=Scale(0.05, torque=1),
        ),
        Parameter(
            f"n_cog{ending}",
            f"n_{{cog{mark}}}",
            "1",
            12.0,
            0.05,
            1e5,
            "log",
            "periods a turn (an integer on the motor's own shaft)",
            "start value",
            held="always",
        ),
        Parameter(
            f"phi_cog{ending}",
            rf"\varphi_{{cog{mark}}}",
            "rad",
            0.0,
            -6.5,
            6.5,
            "identity",
            "phase at angle zero",
            "start value",
        ),
    )


def _screening(c: Context) -> Iterator[Basis]:
    if "torque" not in c.residual:
        return
    theta = c.motion.theta
    for n in best_harmonics(c, np.ones(len(theta))):

        def start(b: F64, n: int = n) -> dict[str, float]:
            size, angle = phase(b[0], b[1])
            return {"Tcog": size, "n_cog": float(n), "phi_cog": angle}

        columns = (c.torque(f"sin {n}", np.sin(n * theta)), c.torque(f"cos {n}", np.cos(n * theta)))
        yield Basis(columns, start, 3)


def _harmonic(ending: str) -> Effect:
    parameters = _parameters(ending)
    Tcog, n_cog, phi_cog = (p.name for p in parameters)
    T, n, phi = (p.symbol for p in parameters)

    def terms(s: Signals) -> Terms:
        phase = s.p[n_cog] * s.theta + s.p[phi_cog]
        return Terms(load_torque=s.p[Tcog] * mean_sine(phase, s.p[n_cog] * s.omega * s.h))

    return Effect(
        name=f"cogging_torque{ending}",
        cause="Magnets pull towards the armature's slots: a torque that follows the angle, with or without current; a "
        "bent screw, a gear's tooth or belt pitch leaves the same trace at its own period.",
        equation=rf"{T}\sin({n}\theta + {phi})",
        parameters=parameters,
        terms=terms,
        screening=None if ending else _screening,
        regressors=Regressors(
            shaft=wave(f"cog{ending}", parameters[0], parameters[2]),
            signals=lambda c, value: sine_and_cosine(value[n_cog] * c.angle),
        ),
        phases={phi_cog: n_cog},
        kind="angle",
        ladder=110,
        told_from={}
        if ending
        else {
            "torque_ripple": "turn slowly through a revolution, once idle and once under load: ripple grows with the "
            "current, cogging is there without any.",
            "encoder_eccentricity": "let it coast with the drive off: cogging still pulls the speed, an eccentric "
            "encoder only seems to.",
            "periodic_disturbance": "repeat it at another speed: cogging stays with the angle, a disturbance with "
            "the clock.",
        },
        substeps=2,
        further="cogging_torque" if ending else "",
    )


EFFECTS = tuple(_harmonic(ending) for ending in HARMONICS)
