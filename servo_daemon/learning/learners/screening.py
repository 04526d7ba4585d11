"""Which features are worth keeping: a random forest and permutation importance on motors it has not seen (Breiman,
*Machine Learning* 45, 2001), grouped, because one of two features that say the same looks useless beside the other.

Features whose rank correlation is high form a group and are permuted together. Groups are kept in order of what their
loss costs; of the shares tried the smallest whose held-out error is within 2 % of that with all features is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform
from sklearn.ensemble import RandomForestRegressor

from servo_daemon.samples import F64

#: Rank correlation from which features belong together (complete linkage).
_ALIKE = 0.9
#: Shares of the features that may be kept, and what keeping so few may cost. A forest does as well with a fifth of
#: them, but a GRNN, which has a bandwidth for each, is 5 % better with two fifths and gains nothing by more.
_SHARES = (0.4, 0.5)
_MOST_LOSS = 0.02
_TREES, _REPEATS = 60, 3


@dataclass(frozen=True)
class Screening:
    """Result.

    Attributes:
        kept: indices of features, the most important first.
        importance: shape (d,): by how much the held-out error rises when the feature's group is permuted, as a share.
        group: shape (d,): which features were permuted together.
        error_all, error_kept: held-out error of the forest with all and with the kept features.
    """

    kept: NDArray[np.intp]
    importance: F64
    group: NDArray[np.intp]
    error_all: float
    error_kept: float

    @property
    def loss(self) -> float:
        """What dropping the others costs, as a share of the error."""
        return self.error_kept / self.error_all - 1.0


def forest(trees: int, seed: int) -> RandomForestRegressor:
    """The forest that screens; also the one that `train --learner forest` predicts with. It grows in one thread:
    scikit-learn's set the filters of warnings for all threads of the process, and win 2 s of a training of 140 s."""
    return RandomForestRegressor(n_estimators=trees, min_samples_leaf=3, max_features=0.33, n_jobs=1, random_state=seed)


def forest_prediction(fitted: RandomForestRegressor, X: F64) -> F64:
    """What `fitted.predict(X)` is, without filters of warnings, which other threads would see: shape (n, m)."""
    rows = np.ascontiguousarray(X, dtype=np.float32)
    return np.asarray(np.mean([tree.predict(rows, check_input=False) for tree in fitted.estimators_], axis=0))


def screen(X: F64, y: F64, held_out: NDArray[np.bool_], *, seed: int = 0) -> Screening:
    """Screen prepared features.

    Args:
        X: shape (n, d).
        y: shape (n, m), outputs of comparable size.
        held_out: shape (n,): windows of motors that the forest is not to see.
    """
    train, y_test, X_test = ~held_out, y[held_out], X[held_out]
    fitted = forest(_TREES, seed).fit(X[train], y[train])
    base = _error(forest_prediction(fitted, X_test), y_test)
    group = correlated_groups(X[train])
    importance = _importance(fitted, X_test, y_test, base, group, np.random.default_rng(seed))
    order = np.argsort(-importance, kind="stable")
    sizes = sorted({max(1, int(share * X.shape[1])) for share in _SHARES})
    for size in sizes:
        kept = _within_groups(order, group, size)
        with_kept = forest(_TREES, seed).fit(X[train][:, kept], y[train])
        error = _error(forest_prediction(with_kept, X_test[:, kept]), y_test)
        if error <= (1.0 + _MOST_LOSS) * base or size == sizes[-1]:
            return Screening(kept, importance, group, base, error)
    raise AssertionError("no share of the features was tried")


def correlated_groups(X: F64) -> NDArray[np.intp]:
    """Which features say the same: labels from 0, shape (d,)."""
    if X.shape[1] < 2:
        return np.zeros(X.shape[1], dtype=np.intp)
    ranks = np.argsort(np.argsort(X, axis=0), axis=0).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = np.nan_to_num(np.abs(np.corrcoef(ranks, rowvar=False)))
    distance = np.clip(1.0 - (alike + alike.T) / 2, 0.0, 1.0)
    np.fill_diagonal(distance, 0.0)
    labels = fcluster(linkage(squareform(distance, checks=False), "complete"), 1.0 - _ALIKE, "distance")
    return np.asarray(labels - 1, dtype=np.intp)


def _importance(
    fitted: RandomForestRegressor, X: F64, y: F64, base: float, group: NDArray[np.intp], random: np.random.Generator
) -> F64:
    """Rise of the error when each group's columns are permuted among the windows, as a share; shape (d,)."""
    out = np.zeros(X.shape[1])
    for label in range(int(group.max()) + 1):
        members = np.flatnonzero(group == label)
        errors = []
        for _ in range(_REPEATS):
            shuffled = X.copy()
            shuffled[:, members] = X[np.ix_(random.permutation(len(X)), members)]
            errors.append(_error(forest_prediction(fitted, shuffled), y))
        out[members] = float(np.mean(errors)) / base - 1.0
    return out


def _within_groups(order: NDArray[np.intp], group: NDArray[np.intp], size: int) -> NDArray[np.intp]:
    """So many features in order of importance: two thirds are the foremost of their groups, then relatives of these."""
    seen: set[int] = set()
    first: list[int] = []
    later: list[int] = []
    for k in order.tolist():
        (later if int(group[k]) in seen else first).append(k)
        seen.add(int(group[k]))
    candidates = dict.fromkeys([*first[: max(1, size * 2 // 3)], *later, *first])
    chosen = set(list(candidates)[:size])
    return np.array([k for k in order.tolist() if k in chosen], dtype=np.intp)


def _error(predicted: F64, y: F64) -> float:
    """Mean absolute error over all outputs, each in units of its own spread."""
    spread = np.maximum(np.mean(np.abs(y - np.median(y, axis=0)), axis=0), 1e-12)
    return float(np.mean(np.abs(predicted - y) / spread))
