"""The inner step: fine enough for the fastest pole of this motor with these effects, and for what it sweeps past."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from .motors import Motor
from .native import F64

LONGEST_S = 20e-6
SHORTEST_S = 0.2e-6
#: Step times pole: after many fourth-order steps a transient is off by 0.05⁴/120 = 5e-8 of its size.
_POLE = 0.05
#: How much of an angle or a width may pass in a step; Simpson's rule, which this is for a forcing, then has 0.15⁵/2880.
_SWEEP = 0.15


def inner_step_s(motor: Motor, setup: Mapping[str, float], inputs: Mapping[str, F64 | float]) -> float:
    """The step for the integrator, s.

    Raises:
        ValueError: it would have to be shorter than `SHORTEST_S`; the effect is too stiff to be generated.
    """
    step = min(LONGEST_S, _POLE / _fastest_pole(motor, setup, inputs), _SWEEP / _fastest_sweep(motor, setup))
    if step < SHORTEST_S:
        raise ValueError(f"{motor.name}: an inner step of {step:.2g} s would be needed; something is too stiff")
    return step


def _fastest_pole(motor: Motor, setup: Mapping[str, float], inputs: Mapping[str, F64 | float]) -> float:
    """1/s; the extremes of parameters that vary are taken together."""
    R, K = float(np.max(inputs["R"])) + max(0.0, setup.get("dR", 0.0)), float(np.max(inputs["K"]))
    L, J = float(np.min(inputs["L"])), float(np.min(inputs["J"]))
    B = max(float(np.max(inputs["B"])), setup.get("B_neg", 0.0))
    B += 2 * setup.get("c2", 0.0) * motor.speed_max_rad_s
    if setup.get("T_eddy"):
        B += 2 * setup["T_eddy"] / setup["w_eddy"]
    if setup.get("c_root"):
        B += setup["c_root"] / math.sqrt(setup["w_root"])
    if setup.get("ws"):  # an unstable pole: friction falls as the speed rises
        B += abs(setup["Ts"] - setup["Tc"]) / setup["ws"]
    if setup.get("I_L"):
        L /= 1 + (motor.current_limit_A / setup["I_L"]) ** 2
    poles = list(np.abs(np.linalg.eigvals([[-R / L, -K / L], [K / J, -B / J]])))
    if setup.get("J_l"):
        inverse = 1 / J + 1 / setup["J_l"]
        poles += [math.sqrt(setup["k_s"] * inverse), setup["c_s"] * inverse]
    if setup.get("T_hyst"):
        poles.append(math.sqrt(abs(setup["T_hyst"]) / (setup["theta_hyst"] * J)))
    if setup.get("Tg"):
        poles.append(math.sqrt(abs(setup["Tg"]) / J))
    poles += [
        math.sqrt(abs(setup[f"Tcog{k}"]) * setup[f"n_cog{k}"] / J) for k in ("", "_2", "_3") if f"Tcog{k}" in setup
    ]
    if setup.get("C_th"):
        poles.append(1 / (setup["R_th"] * setup["C_th"]))
    if setup.get("t_lag"):
        poles.append(1 / setup["t_lag"])
    return float(max(poles))


def _fastest_sweep(motor: Motor, setup: Mapping[str, float]) -> float:
    """1/s: how many radians or characteristic widths pass in a second at most."""
    speed = motor.speed_max_rad_s
    sweeps = [1.0, 2 * math.pi * setup.get("f_per", 0.0), speed if setup.get("Tg") else 0.0]
    sweeps += [speed * setup[f"n_cog{k}"] for k in ("", "_2", "_3") if setup.get(f"Tcog{k}")]
    if setup.get("k_rip"):
        sweeps.append(speed * setup["n_rip"])
    if setup.get("T_hyst"):
        sweeps.append(speed / setup["theta_hyst"])
    if setup.get("T_spot"):
        sweeps.append(speed / setup["width_spot"])
    if setup.get("J_sector"):
        sweeps.append(speed / setup["edge_sector"])
    if setup.get("ws"):  # how fast the motor accelerates through the Stribeck speed
        sweeps.append(motor.K * motor.current_limit_A / motor.J / setup["ws"])
    return max(sweeps)
