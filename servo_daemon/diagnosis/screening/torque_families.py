"""Candidates that act on the shaft: friction, loads, what repeats over the turn or in time.

The equations are those of the effects (design.md, section 4); τ counts positive against positive motion.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.diagnosis.screening.basis import Basis, Context, Family, phase, positive
from servo_daemon.identification.output_error.problem.spectrum import spectral_lines
from servo_daemon.samples import F64

#: Harmonics of the turn that are looked at, and how many of the best are tried exactly.
HARMONICS, _TRIED = 64, 3
#: Stribeck speeds as shares of the usual speed.
_STRIBECK = np.geomspace(0.005, 0.6, 9)
#: No gear loses more; without a bound the torque itself would explain what is missing of it.
_MOST_MU = 0.6
#: A harmonic is looked for where a sample passes no more of it than this, rad.
_RESOLVED, _SECTORS = 1.5, 4096


def _asymmetric(c: Context) -> Iterator[Basis]:
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

    yield Basis("asymmetric_friction", columns, start, 3)


def _stribeck(c: Context) -> Iterator[Basis]:
    usual, Tc = float(np.percentile(np.abs(c.motion.omega), 95.0)), c.motion.p.get("Tc", 0.0)
    for ws in _STRIBECK * usual:

        def start(b: F64, ws: float = float(ws)) -> dict[str, float] | None:
            return {"Tc": Tc + b[0], "Ts": Tc + b[0] + b[1], "ws": ws} if positive(Tc + b[0], b[1]) else None

        bump = c.rest_friction * np.exp(-((c.motion.omega / ws) ** 2))
        yield Basis("stribeck_friction", (c.torque("sgn", c.rest_friction), c.torque(f"bump {ws}", bump)), start, 3)


def _along_travel(c: Context) -> Iterator[Basis]:
    if "position_rad" not in c.channels:  # where a run begins along the travel nobody knows
        return
    theta, Tc = c.motion.theta, c.motion.p.get("Tc", 0.0)

    def start(b: F64) -> dict[str, float] | None:
        level = Tc + b[0]
        return {"Tc": level, "Tc_slope": b[1] / level, "Tc_curve": b[2] / level} if positive(level) else None

    columns = (
        c.torque("sgn", c.rest_friction),
        c.torque("theta sgn", c.rest_friction * theta),
        c.torque("theta² sgn", c.rest_friction * theta**2),
    )
    yield Basis("position_dependent_friction", columns, start, 3)


def _by_load(c: Context) -> Iterator[Basis]:
    if "K" not in c.motion.p:
        return

    def start(b: F64) -> dict[str, float] | None:
        return {"mu": b[0]} if positive(b[0]) and b[0] < _MOST_MU else None

    load = np.abs(c.motion.p["K"] * c.motion.i) * c.rest_friction
    yield Basis("load_dependent_friction", (c.torque("load sgn", load),), start, 1)


def _gravity(c: Context) -> Iterator[Basis]:
    def start(b: F64) -> dict[str, float]:
        size, angle = phase(b[0], b[1])
        return {"Tg": size, "phi_g": angle}

    theta = c.motion.theta
    yield Basis("gravity_load", (c.torque("sin 1", np.sin(theta)), c.torque("cos 1", np.cos(theta))), start, 2)


def best_harmonics(c: Context, weight: F64, series: str = "torque") -> list[int]:
    """The harmonics of the turn, from 2 on, that a raw series shows most, modulated by a weight of shape (n,)."""
    theta, r = c.motion.theta, np.where(c.motion.rest, 0.0, c.residual[series] * weight)
    least = int(np.ceil(2 * np.pi / max(float(np.ptp(theta)), 1e-9)))  # one whole period must have been passed
    sector = np.mod(theta * (_SECTORS / (2 * np.pi)), _SECTORS).astype(int) % _SECTORS
    passed, power = np.abs(c.motion.omega * c.motion.h), np.zeros(HARMONICS + 1)
    low = max(2, least)
    while low <= HARMONICS:  # octave by octave: sums by sector, then all harmonics at once
        high = min(2 * low - 1, HARMONICS)
        resolved = passed * high < _RESOLVED
        sums = np.bincount(sector[resolved], r[resolved], _SECTORS)
        power[low : high + 1] = np.abs(np.fft.rfft(sums)[low : high + 1]) ** 2 / max(int(resolved.sum()), 1)
        low = high + 1
    ranked = np.argsort(power)[::-1][:_TRIED]
    return [int(n) for n in ranked if power[n] > 0]


def _cogging(c: Context) -> Iterator[Basis]:
    if "torque" not in c.residual:
        return
    theta = c.motion.theta
    for n in best_harmonics(c, np.ones(len(theta))):

        def start(b: F64, n: int = n) -> dict[str, float]:
            size, angle = phase(b[0], b[1])
            return {"Tcog": size, "n_cog": float(n), "phi_cog": angle}

        columns = (c.torque(f"sin {n}", np.sin(n * theta)), c.torque(f"cos {n}", np.cos(n * theta)))
        yield Basis("cogging_torque", columns, start, 3)


def step_instants(r: F64, weight: F64) -> list[int]:
    """Where a step of the coefficient of `weight`, shape (n,), explains most of r: from sample k on."""
    after, room = np.cumsum((r * weight)[::-1])[::-1], np.cumsum((weight**2)[::-1])[::-1]
    n, total = len(r), max(float(room[0]), 1e-300)
    explained = after**2 / np.maximum(room, 1e-300)
    # Measured against the rest before it as well: what is there throughout is no step.
    contrast = (after - room / total * after[0]) ** 2 / np.maximum(room * (1 - room / total), 1e-6 * total)
    within = (np.arange(n) >= 0.02 * n) & (np.arange(n) <= 0.98 * n) & (room > 0.01 * total) & (room < 0.99 * total)
    if not within.any():
        return []
    return sorted({int(np.argmax(np.where(within, s, -1.0))) for s in (explained, contrast)})


def _load_step(c: Context) -> Iterator[Basis]:
    if "torque" not in c.residual:
        return
    t = c.motion.t
    for k in step_instants(c.residual["torque"], np.where(c.motion.rest, 0.0, 1.0)):

        def start(b: F64, at: float = float(t[k])) -> dict[str, float]:
            return {"dTL": b[0], "t_TL": at}

        yield Basis("load_torque_step", (c.torque(f"step {k}", (t >= t[k]).astype(float)),), start, 2)


def _periodic(c: Context) -> Iterator[Basis]:
    if "torque" not in c.residual:
        return
    t = c.motion.t
    for f in spectral_lines(t, c.residual["torque"], 2):

        def start(b: F64, f: float = f) -> dict[str, float]:
            size, angle = phase(b[0], b[1])
            return {"Tper": size, "f_per": f, "phi_per": angle}

        wave = 2 * np.pi * f * (t + c.motion.h / 2)
        yield Basis(
            "periodic_disturbance",
            (c.torque(f"sin f {f}", np.sin(wave)), c.torque(f"cos f {f}", np.cos(wave))),
            start,
            3,
        )


FAMILIES: dict[str, Family] = {
    "asymmetric_friction": _asymmetric,
    "stribeck_friction": _stribeck,
    "position_dependent_friction": _along_travel,
    "load_dependent_friction": _by_load,
    "gravity_load": _gravity,
    "cogging_torque": _cogging,
    "load_torque_step": _load_step,
    "periodic_disturbance": _periodic,
}
