"""The closed-form exponential of the linear core against SciPy's, and where SciPy's own is not exact enough, itself."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from servo_daemon.plant import flow
from servo_daemon.plant.build import build_plant
from servo_daemon.samples import F64

_Z = ca.SX.sym("Z", 2, 2)
_PHI = ca.Function(
    "phi", [_Z], [f.alpha * ca.SX.eye(2) + f.beta * _Z for f in flow.phi_matrix(_Z)], ["Z"], ["exp", "phi1", "phi2"]
)
_z = ca.SX.sym("z")
_PHI_SCALAR = ca.Function("phi_scalar", [_z], list(flow.phi_scalar(_z)))


def phi(Z: F64) -> list[F64]:
    return [np.asarray(f) for f in _PHI(Z)]


def phi_by_scipy(Z: F64) -> list[F64]:
    """φ_0, φ_1, φ_2 as blocks of one exponential (Al-Mohy & Higham 2011, theorem 2.1)."""
    n = Z.shape[0]
    augmented = np.zeros((3 * n, 3 * n))
    augmented[:n, :n], augmented[:n, n : 2 * n], augmented[n : 2 * n, 2 * n :] = Z, np.eye(n), np.eye(n)
    top = expm(augmented)[:n]
    return [top[:, :n], top[:, n : 2 * n], top[:, 2 * n :]]


def random_motor(rng: np.random.Generator, h_R_over_L: float) -> F64:
    """A·h of a random motor in coordinates (√L i, √J ω), in which energy is the norm and A is dissipative."""
    electrical = h_R_over_L
    mechanical = h_R_over_L * 10 ** rng.uniform(-5, 0.5)
    coupling = np.sqrt(electrical * mechanical) * 10 ** rng.uniform(-2, 1)
    return np.array([[-electrical, -coupling], [coupling, -mechanical]])


def test_against_scipy_over_random_motors() -> None:
    rng = np.random.default_rng(1)
    compared = 0
    for h_R_over_L in np.geomspace(1e-4, 100, 600):
        Z = random_motor(rng, h_R_over_L)
        if np.linalg.norm(Z, 2) > 100:  # SciPy's squaring loses digits beyond
            continue
        compared += 1
        for ours, theirs in zip(phi(Z), phi_by_scipy(Z), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)
    assert compared > 400


@pytest.mark.parametrize("relative_gap", [0.0, 1e-14, 1e-9, 1e-5, 1e-3, 3e-2, 0.3])
@pytest.mark.parametrize("size", [1e-3, 0.3, 0.5, 0.71, 1.0, 3.0, 30.0])
@pytest.mark.parametrize("sign", [-1, 1])
def test_nearly_equal_eigenvalues_and_branch_edges(relative_gap: float, size: float, sign: int) -> None:
    """Where the branches meet: a double eigenvalue, and one a little to either side of it (real and complex)."""
    gap = sign * relative_gap * size
    Z = np.array([[-size, gap], [abs(gap), -size]])  # eigenvalues −size ± √(gap·|gap|)
    for ours, theirs in zip(phi(Z), phi_by_scipy(Z), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


def test_stiff_steps_keep_the_semigroup_property() -> None:
    """x(h) in one step and in two halves, up to h R/L = 2000, where expm is no reference any more."""
    rng = np.random.default_rng(2)
    for h_R_over_L in np.geomspace(1, 2000, 300):
        Z = random_motor(rng, h_R_over_L)
        whole, halves = phi(Z), phi(Z / 2)
        exp2, first2, second2 = halves
        np.testing.assert_allclose(whole[0], exp2 @ exp2, rtol=0, atol=1e-12)
        np.testing.assert_allclose(whole[1], (first2 + exp2 @ first2) / 2, rtol=0, atol=1e-12)
        np.testing.assert_allclose(whole[2], (second2 + first2 + exp2 @ second2) / 4, rtol=0, atol=1e-12)


def test_the_stiff_limit_is_the_steady_state() -> None:
    """φ_1(Z) → −Z⁻¹ when every mode has died out."""
    Z = np.array([[-2000.0, -400.0], [400.0, -1500.0]])
    np.testing.assert_allclose(phi(Z)[1], -np.linalg.inv(Z), rtol=1e-13, atol=1e-17)


@pytest.mark.parametrize("z", [0.0, -1e-300, -1e-12, -0.1, -0.4999999, -0.5, -0.5000001, -1.0, -40.0, -1e4])
def test_scalar_functions(z: float) -> None:
    for ours, theirs in zip(_PHI_SCALAR(z), phi_by_scipy(np.array([[max(z, -100.0)]])), strict=True):
        if z >= -100:
            np.testing.assert_allclose(float(ours), theirs[0, 0], rtol=1e-13)
    if z < -100:
        np.testing.assert_allclose([float(f) for f in _PHI_SCALAR(z)], [0.0, -1 / z, (-1 / z - 1) / z], atol=1e-17)


def test_the_step_is_the_exponential_of_the_balances() -> None:
    """The composed linear step, angle and input included, against expm of its own Jacobian's flow, in energy units."""
    model = build_plant(())
    rng = np.random.default_rng(3)
    for _ in range(200):
        R, tau_e = 10 ** rng.uniform(-2, 2), 10 ** rng.uniform(-5, -1)
        L, K, J = R * tau_e, 10 ** rng.uniform(-3, 0), 10 ** rng.uniform(-6, -1)
        B = 10 ** rng.uniform(-6, -1)
        A = np.array([[-R / L, -K / L, 0, 1 / L], [K / J, -B / J, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]])
        h = tau_e * 10 ** rng.uniform(-4, 1.5)
        scale = np.diag([np.sqrt(L), np.sqrt(J), np.sqrt(J) / h, np.sqrt(L) / h])
        scaled = scale @ A @ np.linalg.inv(scale) * h
        if np.linalg.norm(scaled, 2) > 100:
            continue
        x, u = np.array([1 / np.sqrt(L), 1 / np.sqrt(J), h / np.sqrt(J)]), h / np.sqrt(L)
        ours = np.asarray(model.step(x, u, [R, L, K, J, B], 0.0, h)).ravel()
        theirs = expm(scaled) @ np.ones(4)
        np.testing.assert_allclose(np.diag(scale)[:3] * ours, theirs[:3], rtol=1e-12, atol=1e-12)
