"""The recursion: exact where least squares is, forgetting only where something new is learned."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from servo_daemon.estimators import rls as rls_module
from servo_daemon.estimators.rls import SYSTEMATIC, DirectionalRls

TRUE = np.array([2.0, -0.5, 30.0])


def rows(rng: np.random.Generator, n: int, scale: tuple[float, ...] = (1.0, 100.0, 0.01)) -> np.ndarray:
    return rng.normal(size=(n, 3)) * np.array(scale)


def test_equals_batch_least_squares_where_nothing_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rls_module, "SYSTEMATIC", 0.0)
    rng = np.random.default_rng(0)
    Phi = rows(rng, 400)
    y = Phi @ TRUE + 0.01 * rng.normal(size=400)
    rls = DirectionalRls(3, memory=1e12)
    for k in range(0, 400, 7):
        rls.update(Phi[k : k + 7], y[k : k + 7])
    found = rls.estimate()
    assert found is not None
    expected = np.linalg.lstsq(Phi, y, rcond=None)[0]
    np.testing.assert_allclose(found.value, expected, rtol=1e-6)
    residual = y - Phi @ expected
    expected_covariance = np.linalg.inv(Phi.T @ Phi) * (residual @ residual) / 397
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(expected_covariance), rtol=0.1)


def test_reported_spread_is_the_real_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rls_module, "SYSTEMATIC", 0.0)
    errors = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        rls = DirectionalRls(3, memory=1e6)
        Phi = rows(rng, 60)
        rls.update(Phi, Phi @ TRUE + 0.05 * rng.normal(size=60))
        found = rls.estimate()
        assert found is not None
        errors.append((found.value - TRUE) / np.sqrt(np.diag(found.covariance)))
    assert np.std(errors) == pytest.approx(1.0, abs=0.12)


def test_an_error_of_the_model_does_not_average_out() -> None:
    """However many rows: a y that is off by a thousandth of its size leaves the coefficients as uncertain."""
    rng = np.random.default_rng(5)
    std = []
    for n in (1_000, 100_000):
        rls = DirectionalRls(3, memory=1e9)
        Phi = rows(rng, n)
        rls.update(Phi, Phi @ TRUE + 1e-6 * rng.normal(size=n))
        found = rls.estimate()
        assert found is not None
        std.append(np.sqrt(np.diag(found.covariance)))
    size = np.sqrt(np.mean((rows(rng, 10_000) @ TRUE) ** 2))
    np.testing.assert_allclose(std[1], SYSTEMATIC * size / np.array([1.0, 100.0, 0.01]), rtol=0.05)
    np.testing.assert_allclose(std[0], std[1], rtol=0.2)


def test_a_regressor_that_is_only_noise_is_not_known() -> None:
    """Errors in variables draw its coefficient towards zero; the std says how little that means."""
    rng = np.random.default_rng(6)
    rls = DirectionalRls(2, memory=1e9)
    true_column = np.full(5000, 3.0)
    y = 2.0 * true_column
    rls.update(np.column_stack([true_column + 1e-4 * rng.normal(size=5000), np.ones(5000)]), y)
    found = rls.estimate()
    assert found is not None
    assert abs(found.value[0] - 2.0) < 2.0 * np.sqrt(found.covariance[0, 0])
    assert np.sqrt(found.covariance[0, 0]) > 10.0


def test_follows_a_change_where_excited() -> None:
    rng = np.random.default_rng(1)
    rls = DirectionalRls(3, memory=200)
    for truth in (TRUE, TRUE * 1.5):
        for _ in range(200):
            Phi = rows(rng, 25)
            rls.update(Phi, Phi @ truth + 0.01 * rng.normal(size=25))
    found = rls.estimate()
    assert found is not None
    np.testing.assert_allclose(found.value, TRUE * 1.5, rtol=0.03)


def test_does_not_forget_a_direction_that_is_not_excited() -> None:
    """A million rows that show only the first coefficient leave the others as they were: no wind-up."""
    rng = np.random.default_rng(2)
    rls = DirectionalRls(3, memory=200)
    Phi = rows(rng, 2000)
    rls.update(Phi, Phi @ TRUE + 0.01 * rng.normal(size=2000))
    before = rls.estimate()
    assert before is not None
    for _ in range(2000):
        idle = rows(rng, 500, (1.0, 0.0, 0.0))
        rls.update(idle, idle @ TRUE + 0.01 * rng.normal(size=500))
    after = rls.estimate()
    assert after is not None
    np.testing.assert_allclose(after.value, TRUE, rtol=0.02)
    spread = np.sqrt(np.diag(after.covariance)[1:] / np.diag(before.covariance)[1:])
    assert (spread < 2.0).all() and (spread > 0.5).all()


def test_says_nothing_where_a_direction_was_never_seen() -> None:
    rng = np.random.default_rng(3)
    rls = DirectionalRls(3, memory=1000)
    assert rls.estimate() is None
    for _ in range(50):
        Phi = rows(rng, 10, (1.0, 1.0, 0.0))
        rls.update(Phi, Phi @ TRUE)
    assert rls.estimate() is None


def test_all_zero_rows_are_harmless() -> None:
    rls = DirectionalRls(2, memory=100)
    for _ in range(100):
        rls.update(np.zeros((5, 2)), np.zeros(5))
    assert rls.estimate() is None


def test_a_dying_tail_is_no_regressor() -> None:
    """A column that is 1e-160 before it is anything: y over that overflowed."""
    rng = np.random.default_rng(1)
    rls, theta = DirectionalRls(2, memory=1e4), np.array([2.0, -3.0])
    for k in range(200):
        Phi = rng.normal(size=(5, 2))
        Phi[:, 1] *= 0.0 if k < 5 else 1e-160 if k < 20 else 1.0
        rls.update(Phi, Phi @ theta + 1e-3 * rng.normal(size=5))
    found = rls.estimate()
    assert found is not None
    assert found.value == pytest.approx(theta, abs=1e-3)
    assert found.residual_var < 1e-5


def test_what_no_row_has_shown_is_not_taken_for_noise() -> None:
    """Friction of the positive direction while the shaft turns the other way: its column is rounding errors. A step
    along it would come back as a residual with the first rows of the other direction, and widen every std 30 times."""
    rng = np.random.default_rng(5)
    truth, noise = np.array([0.03, 1.7, 3.7, 2.1, 1.9]), 3e-3
    Phi = rng.normal(size=(200, 5)) * [3.0, 0.15, 0.03, 0.02, 0.1]
    Phi[:6, 1] *= 1e-3
    Phi[:6, 2] *= 1e-15
    y = Phi @ truth + noise * rng.normal(size=200)
    rls = DirectionalRls(5, 300.0)
    for a, b in pairwise((0, 1, 4, 6, *range(8, 201, 3))):
        rls.update(Phi[a:b], y[a:b])
    estimate = rls.estimate()
    assert estimate is not None
    assert estimate.residual_var == pytest.approx(noise**2, rel=0.5)
