"""Empirical Bayes over drives whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.fleet.prior import UNKNOWN, pool

SPREAD = np.array([0.05, 0.08, 0.03])
TYPE = np.log([2.0, 1e-3, 0.05])


def fleet(n: int, seed: int, *, noise: float = 0.1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Truth, own values and covariances of drives whose captures hardly tell the first two apart."""
    rng = np.random.default_rng(seed)
    truth = TYPE + rng.normal(size=(n, 3)) * SPREAD
    size = noise * rng.uniform(0.3, 2.0, n)[:, None, None] ** 2
    correlation = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]])
    S = size**2 * correlation
    own = truth + np.einsum("ijk,ik->ij", np.linalg.cholesky(S), rng.normal(size=(n, 3)))
    return truth, own, S


def test_pooling_brings_drives_nearer_to_the_truth_and_its_intervals_hold() -> None:
    truth, own, S = fleet(200, 1)
    pooled = pool(own, S)
    assert pooled is not None and not pooled.stranger.any()
    before, after = (np.sqrt(np.mean((v - truth) ** 2, axis=0)) for v in (own, pooled.mean))
    assert np.all(after < 0.8 * before)
    z = (pooled.mean - truth) / np.sqrt(np.einsum("ikk->ik", pooled.cov))
    assert 0.93 < np.mean(np.abs(z) < 1.96) < 0.97
    assert np.sqrt(np.diag(pooled.prior.between)) == pytest.approx(SPREAD, rel=0.25)
    assert pooled.prior.mean == pytest.approx(TYPE, abs=0.03)


def test_drives_that_are_well_known_keep_their_values() -> None:
    _, own, S = fleet(50, 2, noise=1e-4)
    pooled = pool(own, S)
    assert pooled is not None
    assert np.max(np.abs(pooled.mean - own)) < 1e-4


def test_no_variance_is_wrong_where_drives_differ_by_far_more_than_they_are_known_to() -> None:
    """And all parameters differ together."""
    rng = np.random.default_rng(9)
    own = np.outer(rng.normal(size=13), [0.7, 0.06, 0.6, 2.0, 3.0]) + 1e-4 * rng.normal(size=(13, 5))
    pooled = pool(own, np.broadcast_to(1e-10 * np.eye(5), (13, 5, 5)))
    assert pooled is not None
    assert np.einsum("ikk->ik", pooled.cov) == pytest.approx(1e-10, rel=0.2)


def test_a_parameter_that_a_drive_does_not_determine_is_taken_from_the_others() -> None:
    truth, own, S = fleet(60, 3, noise=0.02)
    own[0, 2], S[0, 2, 2] = 40.0, UNKNOWN
    pooled = pool(own, S)
    assert pooled is not None and not pooled.stranger.any()
    std = np.sqrt(pooled.cov[0, 2, 2])
    assert std == pytest.approx(SPREAD[2], rel=0.3)
    assert abs(pooled.mean[0, 2] - truth[0, 2]) < 4 * std


@pytest.mark.parametrize("count", [1, 5])
def test_a_drive_of_another_kind_is_named_and_not_drawn_to_the_rest(count: int) -> None:
    _, own, S = fleet(60, 4, noise=0.03)
    own[:count, 0] += 0.8
    pooled = pool(own, S)
    assert pooled is not None
    assert np.flatnonzero(pooled.stranger).tolist() == list(range(count))
    assert pooled.mean[:count] == pytest.approx(own[:count])
    assert np.sqrt(pooled.prior.between[0, 0]) < 0.08


def test_few_drives_are_not_pooled() -> None:
    _, own, S = fleet(7, 5)
    assert pool(own, S) is None
    with pytest.raises(ValueError, match="shape"):
        pool(own, S[:, :2])
