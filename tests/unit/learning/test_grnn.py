"""The GRNN: Specht's formula to the last digit, scikit-learn's contract, bandwidths, prototypes, intervals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import check_grad
from sklearn.utils.estimator_checks import parametrize_with_checks

from servo_daemon.learning.learners.conformal import calibrate
from servo_daemon.learning.learners.grnn import GRNN
from servo_daemon.learning.learners.loo import LeaveOneOut


@parametrize_with_checks([GRNN(), GRNN(n_prototypes=5)])
def test_scikit_learns_contract(estimator: Any, check: Any) -> None:
    check(estimator)


def test_specht_equation_6_to_the_last_digit() -> None:
    rng = np.random.default_rng(1)
    X, y, asked = rng.normal(size=(40, 3)), rng.normal(size=(40, 2)), rng.normal(size=(7, 3))
    h = np.array([0.5, 1.0, 2.0])
    found = GRNN(bandwidth=h).fit(X, y).predict(asked)
    sigma = h * X.std(axis=0)
    for x, value in zip(asked, found, strict=True):
        w = [np.exp(-sum((x[k] - xi[k]) ** 2 / (2 * sigma[k] ** 2) for k in range(3))) for xi in X]
        assert value == pytest.approx(sum(wi * yi for wi, yi in zip(w, y, strict=True)) / sum(w), rel=1e-12)


def test_specht_equation_14_with_prototypes() -> None:
    rng = np.random.default_rng(2)
    X, y = rng.normal(size=(60, 2)), rng.normal(size=60)
    model = GRNN(bandwidth=0.7, n_prototypes=9, random_state=0).fit(X, y)
    assert len(model.centers_) == 9
    assert model.count_.sum() == 60
    assert model.count_ @ model.mean_[:, 0] == pytest.approx(y.sum())
    x = np.array([[0.3, -0.2]])
    z = (x - X.mean(axis=0)) / (0.7 * X.std(axis=0))
    w = np.exp(-0.5 * np.square(z - model.centers_).sum(axis=1))
    expected = (w @ (model.count_ * model.mean_[:, 0])) / (w @ model.count_)
    assert model.predict(x)[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("per_motor", [1, 3])
def test_the_gradient_of_the_left_out_error(per_motor: int) -> None:
    rng = np.random.default_rng(3)
    X, y = rng.normal(size=(30, 4)), rng.normal(size=(30, 2))
    loo = LeaveOneOut(X, y, np.arange(30) // per_motor)
    for start in rng.normal(size=(3, 4)):
        size = float(np.linalg.norm(loo.error(start)[1]))
        assert check_grad(lambda h: loo.error(h)[0], lambda h: loo.error(h)[1], start) < 1e-5 * size + 1e-7


def test_the_left_out_error_leaves_the_whole_motor_out() -> None:
    """Two windows of each motor with equal features and outputs: leaving only one window out would be perfect."""
    rng = np.random.default_rng(4)
    X, y = np.repeat(rng.normal(size=(50, 2)), 2, axis=0), np.repeat(rng.normal(size=(50, 1)), 2, axis=0)
    narrow = np.full(2, -9.0)
    assert LeaveOneOut(X, y, np.arange(100)).error(narrow)[0] < 1e-6
    assert LeaveOneOut(X, y, np.repeat(np.arange(50), 2)).error(narrow)[0] > 0.5


def test_bandwidths_find_what_matters() -> None:
    rng = np.random.default_rng(5)
    X = rng.normal(size=(400, 4))
    y = np.column_stack([np.sin(2 * X[:, 0]), np.cos(2 * X[:, 1])])
    model = GRNN(random_state=0).fit(X, y)
    assert max(model.bandwidth_[:2]) < 0.5
    assert min(model.bandwidth_[2:]) > 3.0
    X_new = rng.normal(size=(200, 4)) * 0.7
    truth = np.column_stack([np.sin(2 * X_new[:, 0]), np.cos(2 * X_new[:, 1])])
    assert np.sqrt(np.mean((model.predict(X_new) - truth) ** 2)) < 0.1


def test_the_spread_follows_the_noise() -> None:
    rng = np.random.default_rng(6)
    X = rng.uniform(-1, 1, size=(3000, 1))
    y = np.where(X[:, 0] > 0, 0.5, 0.05) * rng.normal(size=3000)
    _, std = GRNN(bandwidth=0.2, n_prototypes=300, random_state=0).fit(X, y).predict([[-0.6], [0.6]], return_std=True)
    assert std[0] == pytest.approx(0.05, rel=0.15)
    assert std[1] == pytest.approx(0.5, rel=0.15)


def test_familiarity_falls_away_from_the_data() -> None:
    rng = np.random.default_rng(7)
    X = rng.normal(size=(500, 3))
    for prototypes in (None, 60):
        model = GRNN(bandwidth=0.5, n_prototypes=prototypes, random_state=0).fit(X, X)
        near, middle, far = model.familiarity([[0, 0, 0], [3, 0, 0], [30, 0, 0]])
        assert near > 0 > middle > far
        assert np.isfinite(far)


def test_far_away_the_answer_is_still_a_number() -> None:
    model = GRNN(bandwidth=0.01).fit(np.array([[0.0], [1.0], [2.0]]), np.array([1.0, 2.0, 3.0]))
    assert model.predict([[1e6], [-1e6]]) == pytest.approx([3.0, 1.0])


def test_a_bandwidth_of_zero_and_groups_of_the_wrong_length_are_refused() -> None:
    X, y = np.zeros((4, 2)), np.zeros(4)
    with pytest.raises(ValueError, match="greater than zero"):
        GRNN(bandwidth=np.array([1.0, 0.0])).fit(X, y)
    with pytest.raises(ValueError, match="groups"):
        GRNN().fit(X, y, groups=[1, 2])


def test_conformal_intervals_cover_what_they_promise() -> None:
    """Over many calibrations the coverage is 95 %, on average, of a learner whose own std is three times too small."""
    rng = np.random.default_rng(8)
    covered = []
    for _ in range(200):
        std = rng.uniform(0.5, 2.0, size=(399, 1))
        found = calibrate(std * rng.standard_t(4, size=(399, 1)), np.zeros((399, 1)), std / 3, np.arange(399))
        later = rng.uniform(0.5, 2.0, size=(500, 1))
        covered.append(np.mean(np.abs(later * rng.standard_t(4, size=(500, 1))) <= found.half_width(later / 3)))
    assert np.mean(covered) == pytest.approx(0.95, abs=0.005)


def test_one_window_of_a_motor_counts() -> None:
    y = np.concatenate([np.full(20, 9.0), np.ones(19)])[:, None]
    groups = np.concatenate([np.zeros(20, dtype=int), np.arange(1, 20)])
    found = calibrate(y, np.zeros_like(y), np.ones_like(y), groups)
    assert found.factor_std[0] == 1.0


def test_too_few_motors_to_calibrate() -> None:
    with pytest.raises(ValueError, match="too few"):
        calibrate(np.zeros((18, 1)), np.zeros((18, 1)), np.ones((18, 1)), np.arange(18))
