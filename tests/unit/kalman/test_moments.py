"""Mean and covariance of the filter: a measurement from elsewhere, and what is known apart."""

from __future__ import annotations

import numpy as np

from servo_daemon.kalman.moments import conditioned, set_apart


def covariance(seed: int, n: int = 5) -> np.ndarray:
    A = np.random.default_rng(seed).normal(size=(n, n))
    return A @ A.T


def test_a_measurement_of_some_elements_adds_its_information() -> None:
    P, z, at = covariance(1), np.arange(5.0), np.array([1, 3])
    R, mean = np.diag([0.2, 0.3]), np.array([2.0, -1.0])
    H = np.eye(5)[at]
    information = np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H
    z_after, P_after = conditioned(z, P, at, mean, R)
    assert np.allclose(P_after, np.linalg.inv(information), atol=1e-10)
    expected = np.linalg.solve(information, np.linalg.solve(P, z) + H.T @ np.linalg.solve(R, mean))
    assert np.allclose(z_after, expected, atol=1e-9)
    assert (P_after == P_after.T).all()


def test_what_is_set_apart_is_correlated_with_nothing_else() -> None:
    P = covariance(2)
    rest = np.ix_([0, 2, 4], [0, 2, 4])
    kept, own = P[rest].copy(), np.array([[2.0, 0.5], [0.5, 3.0]])
    set_apart(P, [1, 3], own)
    assert (P[rest] == kept).all()
    assert (P[np.ix_([1, 3], [1, 3])] == own).all()
    assert not P[np.ix_([1, 3], [0, 2, 4])].any()
    assert not P[np.ix_([0, 2, 4], [1, 3])].any()
