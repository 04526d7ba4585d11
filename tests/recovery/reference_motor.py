"""The generator's equations once more: the linear motor exactly, and for scipy every effect whose sign stays.

Written from the table of effects, not from motor.c, so that a slip in one of them shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from tests.recovery.generator import Motor

F64 = NDArray[np.float64]

#: Scales without effect; what no effect has named is 0.
_SCALES = dict.fromkeys(("ws", "width_spot", "w_root", "w_eddy", "edge_sector", "R_th"), 1.0) | dict.fromkeys(
    ("I_sat", "I_L", "C_th", "J_l", "theta_hyst"), math.inf
)


class _Parameters(SimpleNamespace):
    def __getattr__(self, name: str) -> float:
        return 0.0


def _flat(motor: Motor, effects: Mapping[str, Mapping[str, float | str]], sign: int) -> _Parameters:
    p = _Parameters(**_SCALES, B=motor.B, R=motor.R, L=motor.L, K=motor.K, J=motor.J)
    for values in effects.values():
        vars(p).update(values)
    if "stribeck_friction" not in effects:
        p.Ts = p.Tc
    if "asymmetric_friction" in effects and sign < 0:
        p.Ts = p.Tc = p.Tc_neg
        p.B = p.B_neg
    return p


def _dry(p: _Parameters, K: float, i: float, w: float, th: float) -> float:
    spot = math.remainder(th - p.theta_spot, 2 * math.pi) / p.width_spot
    level = p.Tc + (p.Ts - p.Tc) * math.exp(-((w / p.ws) ** 2)) + p.mu * abs(K * i)
    return float((level + p.T_spot * math.exp(-(spot**2) / 2)) * (1 + p.Tc_slope * th + p.Tc_curve * th**2))


def _loads(p: _Parameters, t: float, w: float, th: float) -> float:
    cogging = (
        p.Tcog * math.sin(p.n_cog * th + p.phi_cog)
        + p.Tcog_2 * math.sin(p.n_cog_2 * th + p.phi_cog_2)
        + p.Tcog_3 * math.sin(p.n_cog_3 * th + p.phi_cog_3)
    )
    periodic = p.Tper * math.sin(2 * math.pi * p.f_per * t + p.phi_per)
    drags = p.c2 * w * abs(w) + p.c_root * w / math.sqrt(abs(w) + p.w_root)
    brake = 2 * p.T_eddy * p.w_eddy * w / (p.w_eddy**2 + w**2)
    return float(p.TL + p.Tg * math.sin(th + p.phi_g) + cogging + periodic + drags + brake)


def _inertia(p: _Parameters, th: float) -> tuple[float, float]:
    """J at this angle and its slope."""
    away, half = math.remainder(th - p.theta_sector, 2 * math.pi), p.width_sector / 2
    on, off = (away + half) / p.edge_sector, (away - half) / p.edge_sector
    slope = (math.cosh(on) ** -2 - math.cosh(off) ** -2) / p.edge_sector
    return p.J + 0.5 * p.J_sector * (math.tanh(on) - math.tanh(off)), 0.5 * p.J_sector * slope


def _rates(p: _Parameters, sign: int) -> Callable[[float, F64, float], list[float]]:
    def rates(t: float, y: F64, volts: float) -> list[float]:
        i, w, th, w_load, th_load, rise, lagged, z = y.tolist()
        K = p.K * (1 + p.k_rip * math.sin(p.n_rip * th + p.phi_rip)) / (1 + (i / p.I_sat) ** 2)
        R = p.R * (1 + 0.0039 * rise)
        applied = lagged if p.t_lag else volts
        shaft = p.k_s * (th - th_load) + p.c_s * (w - w_load)
        J, slope = _inertia(p, th)
        torque = K * i - p.B * w - sign * _dry(p, K, i, w, th) - _loads(p, t, w, th) - shaft - p.T_hyst * z
        return [
            (applied - R * i - K * w - sign * p.Vb) / (p.L / (1 + (i / p.I_L) ** 2)),
            (torque - slope * w**2 / 2) / J,
            w,
            shaft / p.J_l,
            w_load,
            (R * i**2 - rise / p.R_th) / p.C_th,
            (volts - lagged) / p.t_lag if p.t_lag else 0.0,
            (w - abs(w) * z) / p.theta_hyst,
        ]

    return rates


def exact_linear(motor: Motor, voltage: F64, dt: float, x: F64, load: float = 0.0) -> F64:
    """Current, speed, angle at the samples, shape (n, 3): the matrix exponential of the motor under held inputs."""
    A = np.zeros((5, 5))
    A[0, [0, 1, 3]] = np.array([-motor.R, -motor.K, 1.0]) / motor.L
    A[1, [0, 1, 4]] = np.array([motor.K, -motor.B, -1.0]) / motor.J
    A[2, 1] = 1.0
    advance = expm(A * dt)[:3]
    rows = [x]
    for volts in voltage[:-1]:
        rows.append(advance @ np.concatenate([rows[-1], [volts, load]]))
    return np.array(rows)


def integrate(
    motor: Motor,
    effects: Mapping[str, Mapping[str, float | str]],
    voltage: F64,
    dt: float,
    start: tuple[float, float, float],
    sign: int = 0,
) -> F64:
    """Current, speed, angle at the samples, shape (n, 3), to a relative 1e-11.

    Args:
        voltage: shape (n,), held for dt each.
        start: current, speed, angle; the load is where the motor is, at rest.
        sign: of the speed and the current throughout; 0: neither dry friction nor brush drop.
    """
    rates = _rates(_flat(motor, effects, sign), sign)
    y = np.array([*start, 0.0, start[2], 0.0, 0.0, 0.0])
    rows = [y]
    for k, volts in enumerate(voltage[:-1].tolist()):
        span = (k * dt, (k + 1) * dt)
        y = solve_ivp(rates, span, y, "DOP853", args=(volts,), rtol=1e-11, atol=1e-12).y[:, -1]
        rows.append(y)
    return np.array(rows)[:, :3]
