"""The recursion: exact where least squares is, and never older, or surer, than the rows allow."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from servo_daemon.regression import rls as rls_module
from servo_daemon.regression.rls import SPANS_S, LinearEstimate, SlidingRls
from servo_daemon.regression.rls_fit import SYSTEMATIC
from servo_daemon.samples import F64

TRUE = np.array([2.0, -0.5, 30.0])


def take(rls: SlidingRls, Phi: F64, y: F64, second: int = 0, expected: float | None = None) -> None:
    rows = np.column_stack([Phi, y])
    rls.update(float(second), rows.T @ rows, len(y), expected=expected)


def one_window(n: int) -> SlidingRls:
    """All rows of one moment."""
    return SlidingRls(n, (1.0,))


def std_of(found: LinearEstimate) -> F64:
    return np.asarray(np.sqrt(found.covariance.diagonal()))


def rows(rng: np.random.Generator, n: int, scale: tuple[float, ...] = (1.0, 100.0, 0.01)) -> np.ndarray:
    return rng.normal(size=(n, 3)) * np.array(scale)


def test_equals_batch_least_squares_where_nothing_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rls_module, "SYSTEMATIC", 0.0)
    rng = np.random.default_rng(0)
    Phi = rows(rng, 400)
    y = Phi @ TRUE + 0.01 * rng.normal(size=400)
    rls = one_window(3)
    for k in range(0, 400, 7):
        take(rls, Phi[k : k + 7], y[k : k + 7])
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
        rls = one_window(3)
        Phi = rows(rng, 60)
        take(rls, Phi, Phi @ TRUE + 0.05 * rng.normal(size=60))
        found = rls.estimate()
        assert found is not None
        errors.append((found.value - TRUE) / np.sqrt(np.diag(found.covariance)))
    assert np.std(errors) == pytest.approx(1.0, abs=0.12)


def test_an_error_of_the_model_does_not_average_out() -> None:
    """However many rows: a y that is off by a thousandth of its size leaves the coefficients as uncertain."""
    rng = np.random.default_rng(5)
    std = []
    for n in (1_000, 100_000):
        rls = one_window(3)
        Phi = rows(rng, n)
        take(rls, Phi, Phi @ TRUE + 1e-6 * rng.normal(size=n))
        found = rls.estimate()
        assert found is not None
        std.append(np.sqrt(np.diag(found.covariance)))
    size = np.sqrt(np.mean((rows(rng, 10_000) @ TRUE) ** 2))
    np.testing.assert_allclose(std[1], SYSTEMATIC * size / np.array([1.0, 100.0, 0.01]), rtol=0.05)
    np.testing.assert_allclose(std[0], std[1], rtol=0.2)


def test_a_regressor_that_is_only_noise_is_not_known() -> None:
    """Errors in variables draw its coefficient towards zero; the std says how little that means."""
    rng = np.random.default_rng(6)
    rls = one_window(2)
    true_column = np.full(5000, 3.0)
    y = 2.0 * true_column
    take(rls, np.column_stack([true_column + 1e-4 * rng.normal(size=5000), np.ones(5000)]), y)
    found = rls.estimate()
    assert found is not None
    assert abs(found.value[0] - 2.0) < 2.0 * np.sqrt(found.covariance[0, 0])
    assert np.sqrt(found.covariance[0, 0]) > 10.0


#: Of regressors whose terms are about as large as each other.
ALIKE = (1.0, 4.0, 0.07)


def followed(truth: F64, noise: float = 0.01) -> list[LinearEstimate]:
    """Of every second of coefficients that change with time; truth shape (seconds, 3)."""
    rng, rls, found = np.random.default_rng(1), SlidingRls(3), []
    for second, theta in enumerate(truth):
        Phi = rows(rng, 100, ALIKE)
        take(rls, Phi, Phi @ theta + noise * rng.normal(size=len(Phi)), second)
        estimate = rls.estimate()
        assert estimate is not None
        found.append(estimate)
    return found


def test_what_does_not_change_is_known_by_the_longest_window() -> None:
    found = followed(np.tile(TRUE, (120, 1)), noise=0.3)
    assert np.mean([e.span_s == SPANS_S[-1] for e in found[40:]]) > 0.8
    errors = np.array([(e.value - TRUE) / std_of(e) for e in found[20:]])
    assert np.abs(errors).max() < 4.0


def test_follows_ageing_and_its_std_holds_the_lag() -> None:
    """40 % in 150 s. A window of 40 s lags by 5 %; one a hundred times as long by half of it all."""
    truth = TRUE * (1.0 + 0.4 * np.arange(150.0)[:, None] / 150.0)
    found = followed(truth)
    error = np.array([e.value - theta for e, theta in zip(found, truth, strict=True)])[20:]
    assert (np.sqrt(np.mean(np.square(error / truth[20:]), axis=0)) < 0.005).all()
    assert (np.abs(error) < 4.0 * np.array([std_of(e) for e in found])[20:]).all()


def test_a_step_is_doubted_at_once_and_followed_soon() -> None:
    truth = np.where(np.arange(60)[:, None] < 40, TRUE, TRUE * 1.3)
    found = followed(truth)
    for k, (e, theta) in enumerate(zip(found, truth, strict=True)):
        assert (np.abs(e.value - theta) < 4.0 * std_of(e)).all(), k
    assert (std_of(found[40]) > 10.0 * std_of(found[39])).all()
    assert [e.closes for e in found[38:42]] == [True, True, False, False] and found[44].closes
    np.testing.assert_allclose(found[44].value, TRUE * 1.3, rtol=0.01)


def test_a_step_that_a_whole_window_does_not_show_is_doubted_by_the_newest_rows() -> None:
    """1 %, a second after it: without them the old value stands at 5.6 of its standard deviations."""
    found = followed(np.where(np.arange(41)[:, None] < 40, TRUE, TRUE * 1.01))
    assert (np.abs(found[-1].value - TRUE * 1.01) < 2.0 * std_of(found[-1])).all()
    assert [e.closes for e in found[-2:]] == [True, False]


def test_no_direction_is_remembered_for_longer_than_the_window() -> None:
    """However well the others were seen before: afterwards they may have changed, and only the first is shown."""
    rng, rls = np.random.default_rng(2), SlidingRls(3)
    for second in range(120):
        old = second < 60
        Phi = rows(rng, 100, ALIKE if old else (1.0, 1e-3, 1e-5))
        take(rls, Phi, Phi @ (TRUE if old else TRUE * (1.0, 1.5, 0.7)) + 0.01 * rng.normal(size=100), second)
    found = rls.estimate()
    assert found is not None
    assert found.value[0] == pytest.approx(TRUE[0], rel=0.01)
    assert (std_of(found)[1:] > 0.3 * np.abs(TRUE[1:])).all()
    rls.advance(1000.0)
    assert rls.estimate() is None


def test_what_the_rows_leave_beyond_their_noise_is_no_noise() -> None:
    """A term that the model lacks biases the coefficients it goes along with, however many rows there are. Where the
    sensors' noise is known the std says so."""
    rng, told, untold = np.random.default_rng(7), SlidingRls(1), SlidingRls(1)
    for second in range(40):
        Phi = rng.normal(size=(100, 1))
        y = 2.0 * Phi[:, 0] + 0.5 * np.sign(Phi[:, 0]) + 0.01 * rng.normal(size=len(Phi))
        take(told, Phi, y, second, expected=len(y) * 0.01**2)
        take(untold, Phi, y, second)
    biased, doubted = untold.estimate(), told.estimate()
    assert biased is not None and doubted is not None
    assert abs(biased.value[0] - 2.0) > 4.0 * std_of(biased)[0]
    assert abs(doubted.value[0] - 2.0) < 4.0 * std_of(doubted)[0]
    assert biased.closes and not doubted.closes


def test_alike_columns_leave_only_their_own_coefficients_unknown() -> None:
    """Dry friction and a constant load of a motor that turns one way."""
    rng, rls = np.random.default_rng(8), one_window(3)
    for _ in range(10):
        Phi = rng.normal(size=(50, 3))
        Phi[:, 1:] = 1.0
        take(rls, Phi, 2.0 * Phi[:, 0] + 1.0 + 0.01 * rng.normal(size=50))
    found = rls.estimate()
    assert found is not None
    assert found.value[0] == pytest.approx(2.0, abs=0.01) and std_of(found)[0] < 0.01
    assert (std_of(found)[1:] > 1.0).all()


def test_says_nothing_where_a_direction_was_never_seen() -> None:
    rng = np.random.default_rng(3)
    rls = one_window(3)
    assert rls.estimate() is None
    for _ in range(50):
        Phi = rows(rng, 10, (1.0, 1.0, 0.0))
        take(rls, Phi, Phi @ TRUE)
    assert rls.estimate() is None


def test_all_zero_rows_are_harmless() -> None:
    rls = one_window(2)
    for _ in range(100):
        take(rls, np.zeros((5, 2)), np.zeros(5))
    assert rls.estimate() is None


def test_a_dying_tail_is_no_regressor() -> None:
    """A column that is 1e-160 before it is anything: y over that overflowed."""
    rng = np.random.default_rng(1)
    rls, theta = one_window(2), np.array([2.0, -3.0])
    for k in range(200):
        Phi = rng.normal(size=(5, 2))
        Phi[:, 1] *= 0.0 if k < 5 else 1e-160 if k < 20 else 1.0
        take(rls, Phi, Phi @ theta + 1e-3 * rng.normal(size=5))
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
    rls = one_window(5)
    for a, b in pairwise((0, 1, 4, 6, *range(8, 201, 3))):
        take(rls, Phi[a:b], y[a:b])
    estimate = rls.estimate()
    assert estimate is not None
    assert estimate.residual_var == pytest.approx(noise**2, rel=0.5)
