"""Boosted trees as arrays say what scikit-learn's say, for one window in a fraction of the time."""

from __future__ import annotations

import time

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier, HistGradientBoostingRegressor

from servo_daemon.learning.learners.trees import boosted_trees


def test_trees_of_several_outputs_say_the_same() -> None:
    rng = np.random.default_rng(1)
    X = rng.normal(size=(800, 7))
    y = np.column_stack([X[:, 0] * X[:, 1], np.sin(3 * X[:, 2]), np.ones(800)])
    fitted = [HistGradientBoostingRegressor(max_iter=20 + 5 * k, random_state=0).fit(X, y[:, k]) for k in range(3)]
    far = np.vstack([X, 100.0 * X[:50]])
    found = boosted_trees(fitted).predict(far)
    assert np.abs(found - np.column_stack([f.predict(far) for f in fitted])).max() < 1e-9
    assert np.abs(boosted_trees(fitted).predict(far[:1]) - found[:1]).max() < 1e-12


def test_trees_of_a_classifier_are_its_raw_outputs_and_fast() -> None:
    rng = np.random.default_rng(2)
    X = rng.normal(size=(900, 12))
    kind = (X[:, 0] > 0).astype(int) + (X[:, 1] * X[:, 2] > 0.5)
    fitted = HistGradientBoostingClassifier(max_iter=60, random_state=0).fit(X, kind)
    trees = boosted_trees([fitted])
    assert np.abs(trees.predict(X) - fitted.decision_function(X)).max() < 1e-9

    def best(work: object) -> float:
        took = []
        for _ in range(20):
            began = time.process_time()
            work(X[:1])  # type: ignore[operator]
            took.append(time.process_time() - began)
        return min(took)

    assert best(trees.predict) < 0.7 * best(fitted.decision_function)
