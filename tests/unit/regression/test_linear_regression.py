"""Regressions of balances: what is not in the data is not answered, and deviations hold for residuals not white."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from servo_daemon.errors import BadInputError
from servo_daemon.identification.inverse_dynamics.filter import Filter, FilterChoice, choose, rests
from servo_daemon.regression.linear_regression import ROBUST, WHITE, fit_linear, is_determined


def test_dependent_columns_are_named_and_their_coefficients_withheld() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 500))
    fit = fit_linear(("a", "sum", "b", "nothing"), np.column_stack([a, a + 2 * b, b, 0 * a]), 3 * a + b)
    assert fit.names == ()
    tied, alone = sorted(fit.null_directions, key=len, reverse=True)
    assert set(tied) == {"a", "sum", "b"} and alone == {"nothing": 1.0}
    assert tied["a"] / tied["sum"] == pytest.approx(-1) and tied["b"] / tied["sum"] == pytest.approx(-2)
    assert fit.relative_error < 1e-12  # what is determined, the sum of all, is fitted all the same


def test_deviations_hold_for_a_correlated_residual() -> None:
    """A residual of first order, ρ = 0.9, and a regressor that is as slow: σ²(XᵀX)⁻¹ is three times too small."""
    rng = np.random.default_rng(2)
    robust, white = [], []
    for _ in range(200):
        x, e = (lfilter([1.0], [1.0, -0.9], rng.normal(size=3000)) for _ in range(2))
        fit = fit_linear(("x",), x[:, None], 2 * x + 0.5 * e)
        error = fit.value[0] - 2
        robust.append(error / np.sqrt(fit.covariances[ROBUST, 0, 0]))
        white.append(error / np.sqrt(fit.covariances[WHITE, 0, 0]))
    assert np.sqrt(np.mean(np.square(white))) > 2.5
    assert np.sqrt(np.mean(np.square(robust))) == pytest.approx(1.15, abs=0.2)


def test_instruments_take_the_bias_of_noisy_regressors_away() -> None:
    rng = np.random.default_rng(3)
    true = rng.normal(size=20_000)
    x, z = (true + rng.normal(size=20_000) for _ in range(2))
    y = 2 * true
    assert fit_linear(("x",), x[:, None], y).value[0] == pytest.approx(1.0, abs=0.05)
    assert fit_linear(("x",), x[:, None], y, z[:, None]).value[0] == pytest.approx(2.0, abs=0.06)


def test_too_few_rows_are_refused() -> None:
    with pytest.raises(BadInputError, match="only 3 filtered rows"):
        fit_linear(("a", "b"), np.eye(3)[:, :2], np.ones(3))


def test_determined_means_above_noise_and_above_an_error_of_the_model() -> None:
    assert is_determined(1.0, np.array([0.1, 0.1, 0.1]) ** 2)
    assert not is_determined(1.0, np.array([0.6, 0.1, 0.1]) ** 2)
    assert not is_determined(1.0, np.array([0.1, 0.1, 0.5]) ** 2)
    assert not is_determined(-1.0, np.array([0.1, 0.1, 0.1]) ** 2)


def test_both_sides_of_a_balance_are_filtered_alike() -> None:
    """A derivative and its integral through filter, difference and decimation: the same rows, at 200, too."""
    t = np.arange(40_000) * 1e-3
    q = sum(np.sin(2 * np.pi * f * t + f) / f for f in (0.11, 0.31, 0.53))
    v = sum(2 * np.pi * np.cos(2 * np.pi * f * t + f) for f in (0.11, 0.31, 0.53))
    for dynamics, decimation in ((20.0, 10), (1.0, 200)):
        f = Filter(1000.0, dynamics, 5 * dynamics, decimation, 8, (1000, 1000))
        rows = f.decimate(np.column_stack([f.derivative(f.smooth(q)), v]))
        assert len(rows) == len(f.pick(t))
        inner = rows[len(rows) // 10 : -len(rows) // 10]
        np.testing.assert_allclose(inner[:, 0], inner[:, 1], atol=2e-3 * np.max(np.abs(v)))


def test_frequencies_follow_the_noise() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(20_000) * 1e-3
    q = lfilter([1.0], [1.0, -0.95], rng.normal(size=20_000)).cumsum() * 1e-3
    effort = rng.normal(size=20_000)
    clean, noisy = (
        choose(FilterChoice(), 1000.0, [q + s * rng.normal(size=len(t))], [effort], 2) for s in (1e-6, 1e-4)
    )
    assert noisy.dynamics_Hz < clean.dynamics_Hz <= 50.0
    lowpass_Hz = 0.4 * clean.rate_Hz / clean.decimation
    assert lowpass_Hz == pytest.approx(2 * clean.dynamics_Hz, rel=0.2)


def test_rests_are_long_and_still() -> None:
    speed = np.array([1, 0.01, 1, 0.01, 0.02, -0.01, 0.0, 1, 0, 0])
    assert rests(speed, 0.1, 3).tolist() == [False, False, False, True, True, True, True, False, False, False]
