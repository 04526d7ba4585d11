"""Whether the numbers of a model file are those of a model: types, shapes, indices and values of every part.

Compiled code follows a tree's indices without looking: a node that names child 2⁴⁰ ends the process. A hash finds
damage, not intent, so what a file holds is looked at before anything is asked of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from sklearn.decomposition import PCA
from sklearn.ensemble import RandomForestRegressor
from sklearn.linear_model import RidgeCV
from sklearn.neighbors import KNeighborsRegressor
from sklearn.tree import DecisionTreeRegressor

from servo_daemon.errors import BadInputError
from servo_daemon.learning.examples.drawing import CORE
from servo_daemon.learning.examples.training import HEALTHY, TARGETS
from servo_daemon.learning.features import catalogue
from servo_daemon.learning.features.preparation import Preparation
from servo_daemon.learning.learners.familiarity import Familiarity
from servo_daemon.learning.learners.grnn import GRNN
from servo_daemon.learning.learners.trees import BoostedTrees
from servo_daemon.learning.model.novelty import Novelty

#: Levels of a boosted tree: scikit-learn's have at most 31 leaves.
_DEEPEST = 64


def check_parts(parts: Mapping[str, Any], learner: str) -> None:
    """The parts of a model file as `model_file` reads them.

    Raises:
        BadInputError: a part is missing, or of another type, shape or value than any model's; which, without the file.
    """
    try:
        d = _preparation(parts["preparation"])
        kept = _indices("kept", parts["kept"], (None,), d)
        _estimator(parts["estimator"], learner, len(kept))
        _familiarity(parts["familiarity"], d)
        _novelty(parts["strangeness"], d)
        _intervals(parts["intervals"])
    except (KeyError, AttributeError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise BadInputError(f"a part of the model is missing: {error}") from error


def _wrong(name: str, what: str) -> BadInputError:
    return BadInputError(f"{name} {what}, which no model's does")


def _typed(name: str, value: Any, wanted: type) -> None:
    if type(value) is not wanted:
        raise _wrong(name, f"is a {type(value).__name__}")


def _array(name: str, value: Any, shape: tuple[int | None, ...], kinds: str = "f") -> Any:
    """Checked: an array of that shape (None: any length from 1 on), finite."""
    if type(value) is not np.ndarray or value.dtype.kind not in kinds:
        raise _wrong(name, "holds something else than numbers")
    fits = value.ndim == len(shape) and all(n in (None, have) for n, have in zip(shape, value.shape, strict=True))
    if not fits or value.size == 0:
        raise _wrong(name, f"has the shape {value.shape}")
    if not np.isfinite(value).all():
        raise _wrong(name, "holds a value that is not finite")
    return value


def _indices(name: str, value: Any, shape: tuple[int | None, ...], end: int) -> Any:
    """Checked: whole numbers from 0 to below `end`."""
    _array(name, value, shape, "iu")
    if int(value.min()) < 0 or int(value.max()) >= end:
        raise _wrong(name, f"points outside of the {end} there are")
    return value


def _positive(name: str, value: Any, shape: tuple[int | None, ...]) -> Any:
    if not (_array(name, value, shape) > 0).all():
        raise _wrong(name, "holds a value that is not positive")
    return value


def _preparation(p: Any) -> int:
    """Returns the number of features that it leaves."""
    _typed("preparation", p, Preparation)
    d = len(_indices("preparation", p.used_, (None,), len(catalogue.NAMES)))
    _array("preparation", p.middle_, (d,))
    normal = _array("preparation", p.normal_, (None,))
    points = _array("preparation", p.points_, (len(normal), d))
    if (np.diff(points, axis=0) < 0).any() or (points[0] >= points[-1]).any():
        raise _wrong("preparation", "has quantiles that do not grow")
    return d


def _estimator(e: Any, learner: str, d: int) -> None:
    m = len(TARGETS)
    if learner == "grnn":
        _grnn(e, d, m)
    elif learner == "boosting":
        _boosted("boosting", e, d, m)
    elif learner == "forest":
        _forest(e, d, m)
    elif learner == "ridge":
        _typed("ridge", e, RidgeCV)
        _array("ridge", e.coef_, (m, d))
        _array("ridge", e.intercept_, (m,))
    else:
        _typed("neighbours", e, KNeighborsRegressor)
        if (e._fit_method, e.effective_metric_, e.weights) != ("brute", "euclidean", "distance"):
            raise _wrong("neighbours", "has another search or metric")
        X = _array("neighbours", e._fit_X, (None, d))
        _array("neighbours", e._y, (len(X), m))
        if not 1 <= e.n_neighbors <= len(X):
            raise _wrong("neighbours", f"asks for {e.n_neighbors}")


def _grnn(g: Any, d: int, m: int) -> None:
    _typed("GRNN", g, GRNN)
    centers = _array("GRNN", g.centers_, (None, d))
    c = len(centers)
    _array("GRNN", g.size_, (c,))
    _positive("GRNN", g.count_, (c,))
    for values in (g.mean_, g.square_):
        _array("GRNN", values, (c, m))
    _array("GRNN", g._origin, (d,))
    for values in (g.bandwidth_, g._unit):
        _positive("GRNN", values, (d,))


def _boosted(name: str, t: Any, d: int, m: int) -> None:
    """Its way down is `depth_` steps long whatever the indices say; they only have to be indices."""
    _typed(name, t, BoostedTrees)
    nodes = len(_indices(name, t.feature_, (None,), d))
    for values in (t.below_, t.above_):
        _indices(name, values, (nodes,), nodes)
    for values in (t.threshold_, t.value_):
        _array(name, values, (nodes,))
    trees = len(_indices(name, t.root_, (None,), nodes))
    _array(name, t.output_, (trees, m))
    _array(name, t.start_, (m,))
    if type(t.depth_) is not int or not 0 <= t.depth_ <= _DEEPEST:
        raise _wrong(name, f"is {t.depth_} deep")


def _forest(f: Any, d: int, m: int) -> None:
    _typed("forest", f, RandomForestRegressor)
    if (f.n_outputs_, f.n_features_in_) != (m, d) or not f.estimators_:
        raise _wrong("forest", "has other features or outputs")
    for each in f.estimators_:
        _typed("forest", each, DecisionTreeRegressor)
        tree = each.tree_
        if (tree.n_features, tree.n_outputs, tree.max_n_classes) != (d, m, 1):
            raise _wrong("forest", "has a tree of other features or outputs")
        # Arrays over the tree's own memory, whose length its `__setstate__` has checked.
        left, right = tree.children_left, tree.children_right
        nodes = np.arange(len(left))
        inner = left != -1
        for child in (left[inner], right[inner]):
            # A child comes after its parent, so that every way down ends.
            if not ((child > nodes[inner]) & (child < len(left))).all():
                raise _wrong("forest", "has a node whose child is none of the tree's")
        if inner.any():
            _indices("forest", tree.feature[inner], (None,), d)
            _array("forest", tree.threshold[inner], (None,))
        _array("forest", np.asarray(tree.value), (len(left), m, 1))


def _familiarity(f: Any, d: int) -> None:
    _typed("familiarity", f, Familiarity)
    p = f._components
    _typed("familiarity", p, PCA)
    _array("familiarity", p.mean_, (d,))
    k = len(_array("familiarity", p.components_, (None, d)))
    _positive("familiarity", p.explained_variance_, (k,))
    _grnn(f._kernel, k, 1)
    known = _array("familiarity", f.mass_, (None,))
    _array("familiarity", f.outside_, known.shape)


def _novelty(s: Any, d: int) -> None:
    core = len(CORE)
    _typed("novelty", s, Novelty)
    _array("novelty", np.asarray(s._nominal), (core,))
    if not np.isfinite(s._range):
        raise _wrong("novelty", "has a range that is not finite")
    _array("novelty", s.slope_, (d, core))
    _array("novelty", s.start_, (core,))
    _array("novelty", s.known_, (None,))
    kinds = _array("novelty", s.kinds_, (None,), "iu")
    if np.count_nonzero(kinds == HEALTHY) != 1:
        raise _wrong("novelty", "does not know what is healthy")
    # How its inputs are put together: `Novelty._inputs`.
    _boosted("novelty", s._trees, d + 3 * core + 2, len(kinds))


def _intervals(found: Mapping[str, Any]) -> None:
    m = len(TARGETS)
    for name in ("factor", "factor_std", "least_std"):
        if not (_array("intervals", found[name], (m,)) >= 0).all():
            raise _wrong("intervals", "holds a negative width")
    _array("intervals", found["correlation"], (m, m))
