"""The linear core over one step with input and load torque held: exact, and affine in both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import casadi as ca

from servo_daemon.plant import equations, flow

#: What is held over a step and drives the model. Without a voltage signal the measured current is the input.
Drive = Literal["voltage", "current", "torque"]


@dataclass(frozen=True)
class Core:
    """x_next as an affine function of input and load torque.

    Attributes:
        free: x_next for zero input and zero load torque.
        per_input, per_load: its change per unit of either.
        per_slope: per unit of a change of the input across the step about its mean; the angle's share, of third order
            in h, is left out.
    """

    free: ca.SX
    per_input: ca.SX
    per_load: ca.SX
    per_slope: ca.SX


def linear_core(drive: Drive, x: ca.SX, p: Mapping[str, ca.SX], h: ca.SX) -> Core:
    """The core of the drive's states, (i, ω, θ) or (ω, θ)."""
    if drive == "voltage":
        return _voltage_core(x, p, h)
    return _mechanical_core(x, p, h, p["K"] if drive == "current" else ca.SX(1))


def homogeneous(drive: Drive, p: Mapping[str, ca.SX]) -> ca.SX:
    """A of (i, ω)' = A (i, ω) + …, shape (2, 2), 1/s; without a voltage the current is no state: its row is 0."""
    A, _ = _electromechanical(p)
    return A if drive == "voltage" else ca.diag(ca.vertcat(0, A[1, 1]))


def _electromechanical(p: Mapping[str, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """A and B of (i, ω)' = A (i, ω) + B (v, τ): derivatives of the balances, not written again."""
    i, omega, v, tau = (ca.SX.sym(n) for n in ("i", "omega", "v", "tau"))
    rates = ca.vertcat(
        equations.current_rate(v, i, omega, p["R"], p["L"], p["K"]),
        equations.speed_rate(i, omega, tau, p["K"], p["J"], p["B"]),
    )
    return ca.jacobian(rates, ca.vertcat(i, omega)), ca.jacobian(rates, ca.vertcat(v, tau))


def _voltage_core(x: ca.SX, p: Mapping[str, ca.SX], h: ca.SX) -> Core:
    """(i, ω, θ) by the 2 × 2 exponential."""
    A, B = _electromechanical(p)
    Z, b = A * h, B * h
    exp, phi1, phi2 = flow.phi_matrix(Z)
    electromechanical = x[:2]
    free = ca.vertcat(flow.apply(exp, Z, electromechanical), x[2] + h * flow.apply(phi1, Z, electromechanical)[1])
    gains = [ca.vertcat(flow.apply(phi1, Z, b[:, k]), h * flow.apply(phi2, Z, b[:, k])[1]) for k in range(2)]
    slope = flow.apply(phi2, Z, b[:, 0]) - flow.apply(phi1, Z, b[:, 0]) / 2
    return Core(free, gains[0], gains[1], ca.vertcat(slope, 0))


def _mechanical_core(x: ca.SX, p: Mapping[str, ca.SX], h: ca.SX, torque_per_input: ca.SX) -> Core:
    """(ω, θ) with the motor torque held."""
    omega, tau = ca.SX.sym("omega"), ca.SX.sym("tau")
    rate = equations.speed_rate(ca.SX(0), omega, tau, ca.SX(0), p["J"], p["B"])
    exp, phi1, phi2 = flow.phi_scalar(ca.jacobian(rate, omega) * h)
    per_load = ca.jacobian(rate, tau) * h * ca.vertcat(phi1, h * phi2)
    free = ca.vertcat(exp * x[0], x[1] + h * phi1 * x[0])
    slope = ca.jacobian(rate, tau) * h * (phi2 - phi1 / 2)
    return Core(free, -torque_per_input * per_load, per_load, -torque_per_input * ca.vertcat(slope, 0))
