"""The linear core over one step with input and load torque held: exact, and affine in both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import casadi as ca

from servo_daemon.plant import equations, flow

#: Square of h (R/L − B/J) at which the second term of Magnus' expansion is half of itself. Measured against 512
#: substeps (an RE 40, 0.2 to 1.2 rad of a ripple in a substep): as exact as undamped, and where the winding settles
#: within a substep no worse than without the term.
FADES = 40.0

#: φ_0, φ_1, φ_2 of a 2 × 2 matrix.
Phi = Callable[[ca.SX], tuple[flow.MatrixFunction, flow.MatrixFunction, flow.MatrixFunction]]

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


@dataclass(frozen=True)
class Turning:
    """How the torque constant changes within a step.

    Attributes:
        K: that changes.
        moment: `effects.base.Terms.moment_K`.
    """

    K: ca.SX
    moment: ca.SX


def linear_core(
    drive: Drive, x: ca.SX, p: Mapping[str, ca.SX], h: ca.SX, turning: Turning | None = None, phi: Phi = flow.phi_matrix
) -> Core:
    """The core of the drive's states, (i, ω, θ) or (ω, θ).

    Args:
        phi: of a 2 × 2 matrix; needed with a voltage.
        turning: of K about its mean, which is in p; without a voltage it only moves the angle, to third order in h.
    """
    if drive == "voltage":
        return _voltage_core(x, p, h, turning, phi)
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


def _voltage_core(x: ca.SX, p: Mapping[str, ca.SX], h: ca.SX, turning: Turning | None, phi: Phi) -> Core:
    """(i, ω, θ) by the 2 × 2 exponential."""
    A, B = _electromechanical(p)
    to_angle = ca.SX([[0, 1]])
    if turning is not None:
        A, B, to_angle = _turned(A, B, _of_constant(p, turning), h)
    Z, b = A * h, B * h
    exp, phi1, phi2 = phi(Z)
    electromechanical = x[:2]
    free = ca.vertcat(
        flow.apply(exp, Z, electromechanical), x[2] + h * to_angle @ flow.apply(phi1, Z, electromechanical)
    )
    gains = [ca.vertcat(flow.apply(phi1, Z, b[:, k]), h * to_angle @ flow.apply(phi2, Z, b[:, k])) for k in range(2)]
    slope = flow.apply(phi2, Z, b[:, 0]) - flow.apply(phi1, Z, b[:, 0]) / 2
    return Core(free, gains[0], gains[1], ca.vertcat(slope, 0))


def _of_constant(p: Mapping[str, ca.SX], turning: Turning) -> ca.SX:
    """What the constant's change makes of A, times its first moment, shape (2, 2)."""
    A, _ = _electromechanical({**p, "K": turning.K})
    return turning.moment * (A - ca.diag(ca.diag(A)))


def _turned(A: ca.SX, B: ca.SX, N: ca.SX, h: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """A, B and what moves the angle, as they act together while K changes within the step: by the second term of
    Magnus' expansion (Iserles, Munthe-Kaas, Nørsett & Zanna, *Lie-group methods*, Acta Numerica 2000, section 4), the
    commutator of what changes with what does not. The error of a step is then of fifth order in h instead of third.

    It holds where the winding's e-fold takes longer than the step; where it is much shorter the term fades.

    Args:
        N: change of A times its first moment over the step, shape (2, 2).
    """
    fades = 1 / (1 + ((A[0, 0] - A[1, 1]) * h) ** 2 / FADES)
    N = N * fades
    return A + N @ A - A @ N, B + N @ B, ca.horzcat(-N[1, 0], 1 - N[1, 1])


def _mechanical_core(x: ca.SX, p: Mapping[str, ca.SX], h: ca.SX, torque_per_input: ca.SX) -> Core:
    """(ω, θ) with the motor torque held."""
    omega, tau = ca.SX.sym("omega"), ca.SX.sym("tau")
    rate = equations.speed_rate(ca.SX(0), omega, tau, ca.SX(0), p["J"], p["B"])
    exp, phi1, phi2 = flow.phi_scalar(ca.jacobian(rate, omega) * h)
    per_load = ca.jacobian(rate, tau) * h * ca.vertcat(phi1, h * phi2)
    free = ca.vertcat(exp * x[0], x[1] + h * phi1 * x[0])
    slope = ca.jacobian(rate, tau) * h * (phi2 - phi1 / 2)
    return Core(free, -torque_per_input * per_load, per_load, -torque_per_input * ca.vertcat(slope, 0))
