"""What is unlike the training is less familiar, and a learned model has no say about it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from servo_daemon.learning.examples.drawing import draw_parameters
from servo_daemon.learning.examples.training import simulate_motors
from servo_daemon.learning.learners.familiarity import LEAST_FAMILIARITY, Familiarity
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.samples import F64
from tests.learned_models import SPEC, Once, small_model


def windows(n: int, seed: int, strength: float = 1.0) -> F64:
    """Forty features that follow five causes of this strength and a little noise, shape (n, 40)."""
    mixing = np.random.default_rng(0).normal(size=(5, 40))
    rng = np.random.default_rng(seed)
    return np.asarray(strength * rng.normal(size=(n, 5)) @ mixing + 0.1 * rng.normal(size=(n, 40)))


@pytest.fixture(scope="module")
def familiarity() -> Familiarity:
    return Familiarity().fit(windows(1500, 1), windows(1000, 2))


def test_others_like_the_training_pass(familiarity: Familiarity) -> None:
    score = familiarity.score(windows(2000, 3))
    assert (score < LEAST_FAMILIARITY).mean() < 0.03
    assert np.median(score) > 0.1


def test_causes_that_were_never_so_strong_are_declined(familiarity: Familiarity) -> None:
    """Along what the training varied in, further and further out."""
    near, further, far = (float(np.median(familiarity.score(windows(500, 4, by)))) for by in (1.0, 1.5, 6.0))
    assert near > further > far
    assert far < LEAST_FAMILIARITY


def test_a_combination_that_no_motor_showed_is_declined(familiarity: Familiarity) -> None:
    """Each feature within its usual range, and not as they go together."""
    mixed = windows(500, 5)
    for column in mixed.T:
        np.random.default_rng(6).shuffle(column[:: 1 + int(abs(column[0]) > 1)])
    assert (familiarity.score(mixed) < LEAST_FAMILIARITY).mean() > 0.95


class _NeverNovel:
    """Stands for `Novelty`: what is declined is then declined by familiarity alone."""

    def judge(self, looks: object) -> tuple[F64, F64]:
        n = len(looks.extended)  # type: ignore[attr-defined]
        return np.zeros(n), np.zeros(n)

    def share(self, novel: F64) -> F64:
        return np.ones(len(novel))


@pytest.mark.slow
def test_a_model_declines_what_is_unfamiliar(once: Once) -> None:
    """The features of healthy windows, and the same with most of them another motor's and three times as large."""
    model: LearnedModel = dataclasses.replace(small_model(once), novelty=_NeverNovel())  # type: ignore[arg-type]
    features = own_windows()
    healthy = model.predict(features)
    assert np.mean([d == "" for d in healthy.declined]) > 0.8
    odd = features.copy()
    odd[:, 40:] = np.roll(odd[:, 40:], 1, axis=0) * 3.0
    told = model.predict(odd).declined
    assert all(told)
    assert np.mean(["unlike those of the training" in d for d in told]) > 0.5, told  # others for a plainer reason


def own_windows() -> F64:
    """Of motors that the model has not seen, shape (n, features)."""
    return simulate_motors(SPEC, range(300, 330), draw_parameters(SPEC, 330)[300:]).features
