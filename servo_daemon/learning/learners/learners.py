"""The learners that can stand behind a model, on the same prepared and screened features."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestRegressor

from servo_daemon.errors import BadInputError
from servo_daemon.learning import LEARNERS
from servo_daemon.learning.learners.grnn import GRNN
from servo_daemon.learning.learners.screening import forest, forest_prediction
from servo_daemon.learning.learners.trees import boosted_trees
from servo_daemon.samples import F64

#: Of the GRNN: bounds a prediction's time and the model's size. Fewer prototypes than windows cost accuracy (a quarter
#: of 4,000: 5 %), and 6,000 a prediction only 0.2 ms.
PROTOTYPES = 6000
_MAX_WINDOWS, _MAX_ITER = 2000, 60
_TREES = 100


def make_learner(name: str, *, seed: int = 0) -> Any:
    """An estimator with `fit(X, y)` and `predict(X)`.

    Raises:
        BadInputError: no such learner.
    """
    if name == "grnn":
        return GRNN(n_prototypes=PROTOTYPES, max_windows=_MAX_WINDOWS, max_iter=_MAX_ITER, random_state=seed)
    if name == "forest":
        return forest(_TREES, seed)
    if name == "boosting":
        from sklearn.ensemble import HistGradientBoostingRegressor
        from sklearn.multioutput import MultiOutputRegressor

        return MultiOutputRegressor(HistGradientBoostingRegressor(loss="absolute_error", random_state=seed))
    if name == "ridge":
        from sklearn.linear_model import RidgeCV

        return RidgeCV(np.logspace(-2, 4, 13))
    if name == "neighbours":
        from sklearn.neighbors import KNeighborsRegressor

        # A search tree is no faster for so many features, and compiled code would have to believe a file's.
        return KNeighborsRegressor(n_neighbors=8, weights="distance", algorithm="brute")
    raise BadInputError(f"unknown learner {name!r}: there are {', '.join(LEARNERS)}")


def fit_learner(learner: Any, X: F64, y: F64, motor: NDArray[np.int64]) -> Any:
    """Fitted; a GRNN is told which windows are of one motor; of boosting the trees are kept."""
    from sklearn.multioutput import MultiOutputRegressor

    fitted = learner.fit(X, y, groups=motor) if isinstance(learner, GRNN) else learner.fit(X, y)
    return boosted_trees(fitted.estimators_) if isinstance(fitted, MultiOutputRegressor) else fitted


def predict(learner: Any, X: F64) -> tuple[F64, F64]:
    """Outputs and their std by the learner's own idea (1 for one that has none), both of shape (n, m)."""
    if isinstance(learner, GRNN):
        return learner.answer(X)
    is_forest = isinstance(learner, RandomForestRegressor)
    value = forest_prediction(learner, X) if is_forest else np.asarray(learner.predict(X), dtype=np.float64)
    return value, np.ones_like(value)
