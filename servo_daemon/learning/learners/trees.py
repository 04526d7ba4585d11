"""Boosted trees as plain arrays: asked about one window in a tenth of a millisecond.

scikit-learn walks the trees one by one from Python, 5 µs each, which is 3 ms for the six outputs of a model; here the
question of every node is answered at once, then all trees go down together, one level at a time. The arrays are also
all that a model file has to hold of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from servo_daemon.samples import F64

#: Windows are worked off so many at a time: bounds the table of answers.
_ROWS = 64


class BoostedTrees(BaseEstimator):  # type: ignore[misc]  # scikit-learn is untyped
    """Boosted trees in arrays; made by `boosted_trees`.

    Attributes:
        feature_, threshold_, below_, above_, value_: of all nodes of all trees, shape (nodes,): which feature is
            asked, up to which value the way is `below_`, and else `above_`; a leaf leads to itself.
        root_: shape (trees,).
        output_: to which output a tree adds, shape (trees, m), 0 or 1.
        start_: of each output, shape (m,).
        depth_: of the deepest tree.
    """

    feature_: NDArray[np.int64]
    threshold_: F64
    below_: NDArray[np.int64]
    above_: NDArray[np.int64]
    value_: F64
    root_: NDArray[np.int64]
    output_: F64
    start_: F64
    depth_: int

    def predict(self, X: F64) -> F64:
        """Sums of the leaves' values, shape (n, m), for finite features, shape (n, d)."""
        return np.concatenate([self._sums(X[k : k + _ROWS]) for k in range(0, max(len(X), 1), _ROWS)])

    def _sums(self, X: F64) -> F64:
        below = X[:, self.feature_] <= self.threshold_
        onward = np.where(below, self.below_, self.above_)
        window = np.arange(0, onward.size, onward.shape[1])[:, None]
        onward += window
        node = self.root_ + window
        for _ in range(self.depth_):
            node = onward.take(node)
        return np.asarray(self.value_[node - window] @ self.output_ + self.start_)


def boosted_trees(fitted: Sequence[Any]) -> BoostedTrees:
    """The trees of fitted `HistGradientBoosting…` estimators without categories; their raw outputs (a regressor's are
    its predictions) stand side by side."""
    start = np.concatenate([np.asarray(f._baseline_prediction, dtype=np.float64).ravel() for f in fitted])
    tables: list[Any] = []
    output: list[int] = []
    first = 0
    for f in fitted:
        for each in f._predictors:
            tables += [tree.nodes for tree in each]
            output += range(first, first + len(each))
        first += len(f._predictors[0])
    size = np.array([len(t) for t in tables])
    root = np.concatenate([[0], np.cumsum(size)[:-1]])
    nodes, offset = np.concatenate(tables), np.repeat(root, size)
    own, leaf = np.arange(len(nodes)), nodes["is_leaf"].astype(bool)
    out = BoostedTrees()
    out.feature_ = np.where(leaf, 0, nodes["feature_idx"]).astype(np.int64)
    out.threshold_ = np.where(leaf, 0.0, nodes["num_threshold"])
    out.below_ = np.where(leaf, own, nodes["left"] + offset).astype(np.int64)
    out.above_ = np.where(leaf, own, nodes["right"] + offset).astype(np.int64)
    out.value_ = np.where(leaf, nodes["value"], 0.0)
    out.root_ = root.astype(np.int64)
    out.output_ = (np.array(output)[:, None] == np.arange(len(start))).astype(np.float64)
    out.start_, out.depth_ = start, int(nodes["depth"].max())
    return out
