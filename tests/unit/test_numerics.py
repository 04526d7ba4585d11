"""Medians, least squares and scores against NumPy's and against differences."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.numerics import (
    STD_OF_MEDIAN,
    in_long_runs,
    inverse_of_information,
    is_definite,
    least_squares,
    median,
    runs_of,
    sample_period,
    score_and_information,
    upper_median,
    white_noise_var,
)
from servo_daemon.samples import F64


def test_medians_are_numpys() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 10, 101, 200):
        values = rng.normal(size=n)
        assert median(values) == np.median(values)
        assert upper_median(values) == np.sort(values)[n // 2]


def test_noise_on_a_smooth_signal() -> None:
    rng = np.random.default_rng(1)
    noise = 0.02 * rng.normal(size=20_000)
    signal = 5 * np.sin(np.arange(20_000) / 300)
    assert abs(white_noise_var(signal + noise) / 0.02**2 - 1) < 0.05
    assert abs(STD_OF_MEDIAN * median(np.abs(noise)) / 0.02 - 1) < 0.03
    assert white_noise_var(np.ones(7)) == 0.0


def test_columns_of_any_size() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(50, 3)) * [1e-9, 1.0, 1e12]
    wanted = np.array([3e9, -2.0, 5e-12])
    found, rank = least_squares(A, A @ wanted)
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    assert rank == 3
    found, rank = least_squares(np.column_stack([A[:, 1], A[:, 1], np.zeros(50)]), 2 * A[:, 1])
    np.testing.assert_allclose(found, [1.0, 1.0, 0.0], atol=1e-12)
    assert rank == 1


def test_a_gap_does_not_move_the_sample_period() -> None:
    assert sample_period(np.array([0.0, 0.01, 0.02, 5.02, 5.03])) == pytest.approx(0.01)


def test_the_covariance_of_an_information_in_any_units() -> None:
    """Units apart by 1e12, and a third direction of which nothing is known."""
    known = np.array([[4e-12, 1e-6], [1e-6, 2.0]])
    information = np.zeros((3, 3))
    information[:2, :2] = known
    found = inverse_of_information(information)
    np.testing.assert_allclose(found[:2, :2] @ known, np.eye(2), atol=1e-9)
    assert not found[2].any() and not found[:, 2].any()


def test_the_score_is_the_slope_of_the_likelihood_and_the_information_its_spread() -> None:
    """ν ~ N(a, b exp(c)): −2 log p by differences, and Fisher's matrix of a Gaussian's mean and log-variance."""
    rng = np.random.default_rng(2)
    nu = rng.normal(0.3, 1.3, 200_000)

    def terms(a: float, c: float) -> tuple[F64, F64]:
        return (nu - a) / np.exp(c / 2), np.full(len(nu), c)

    def cost(a: float, c: float) -> float:
        e, logs = terms(a, c)
        return float(np.sum(logs + e * e))

    a, c, h = 0.2, 0.4, 1e-5
    e, logs = terms(a, c)
    moved = [terms(a + h, c), terms(a, c + h)]
    gradient, information = score_and_information(
        e, np.array([(m[0] - e) / h for m in moved]), np.array([(m[1] - logs) / h for m in moved])
    )
    slopes = [(cost(a + h, c) - cost(a - h, c)) / (2 * h), (cost(a, c + h) - cost(a, c - h)) / (2 * h)]
    np.testing.assert_allclose(gradient, slopes, rtol=1e-3)
    np.testing.assert_allclose(information, len(nu) * np.diag([2 / np.exp(c), 1.0]), atol=1e-3 * len(nu))


def test_a_matrix_is_definite_beyond_its_least_eigenvalue_and_no_further() -> None:
    A = np.random.default_rng(4).normal(size=(5, 5))
    symmetric = A @ A.T
    least = float(np.linalg.eigvalsh(symmetric)[0])
    kept = symmetric.copy()
    assert is_definite(symmetric)
    assert is_definite(symmetric, 0.999 * least)
    assert not is_definite(symmetric, 1.001 * least)
    assert not is_definite(-symmetric)
    assert (symmetric == kept).all()


def test_runs_are_found_at_both_ends_and_short_ones_left_out() -> None:
    flags = np.array([1, 1, 0, 1, 0, 0, 1, 1, 1], dtype=bool)
    assert runs_of(flags) == [(0, 2), (3, 4), (6, 9)]
    assert runs_of(~flags) == [(2, 3), (4, 6)]
    assert runs_of(np.zeros(0, dtype=bool)) == []
    assert in_long_runs(flags, 2).tolist() == [True, True, False, False, False, False, True, True, True]
    assert not in_long_runs(flags, 4).any()
