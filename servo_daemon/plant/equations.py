"""The two balances of the DC servo, as CasADi expressions. Nothing else in the project writes them.

    L di/dt = v − R i − K ω          armature circuit (Kirchhoff); K is the back-EMF constant
    J dω/dt = K i − B ω − τ_load     shaft (Newton); K is the torque constant, the same number in SI units
      dθ/dt = ω

Source: paper, section 1, figures 1 and 2; Krishnan, *Electric Motor Drives*, 2001, eq. 2.6–2.9.
"""

from __future__ import annotations

import casadi as ca


def current_rate(v: ca.SX, i: ca.SX, omega: ca.SX, R: ca.SX, L: ca.SX, K: ca.SX) -> ca.SX:
    """di/dt, A/s, from voltage v (V), current i (A) and speed omega (rad/s)."""
    return (v - R * i - K * omega) / L


def speed_rate(i: ca.SX, omega: ca.SX, load_torque: ca.SX, K: ca.SX, J: ca.SX, B: ca.SX) -> ca.SX:
    """dω/dt, rad/s², from current i (A), speed omega (rad/s) and opposing load torque (N·m)."""
    return (K * i - B * omega - load_torque) / J
