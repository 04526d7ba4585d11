"""Whether a window shows a fault of the measuring, or a motor outside the range that a model was trained for.

`familiarity` asks whether a window is unlike all of the training. One with a late current is not, nor one of a motor a
little too heavy: they are like windows of other motors, and the estimates are wrong. So such windows are made on
purpose (`faults`, `drawing.draw_outside`) and boosted trees (Friedman, *Annals of Statistics* 29, 2001) learn to tell
the three kinds apart. How strange a window must be to be declined is not learned but read off healthy motors that took
no part in it, as in `conformal`: a further healthy motor's is then declined with a probability of `MOST_STRANGE`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from sklearn.base import BaseEstimator

from servo_daemon.learning.drawing import CORE, TrainingSpec
from servo_daemon.learning.targets import Baseline
from servo_daemon.learning.training import HEALTHY
from servo_daemon.learning.trees import boosted_trees
from servo_daemon.samples import F64

#: So large a share of healthy windows is declined for looking strange.
MOST_STRANGE = 0.03
#: Four times as many tell faults no better.
_ROUNDS, _RATE, _FEATURES_TRIED = 60, 0.12, 0.3


class Strangeness(BaseEstimator):  # type: ignore[misc]  # scikit-learn is untyped
    """See the module.

    Attributes:
        known_: of the calibration windows, sorted, shape (n,).
        kinds_: what the trees' outputs stand for, shape (3,).
    """

    def fit(self, inputs: F64, kind: NDArray[np.int64], calibration: F64, seed: int = 0) -> Strangeness:
        """`strangeness_inputs` of windows of all kinds, shape (n, d), which kind they are, shape (n,), and the inputs
        of healthy windows of other motors, shape (c, d)."""
        from sklearn.ensemble import HistGradientBoostingClassifier

        found = HistGradientBoostingClassifier(
            learning_rate=_RATE,
            max_iter=_ROUNDS,
            max_features=_FEATURES_TRIED,
            early_stopping=False,
            random_state=seed,
        ).fit(inputs, kind)
        self.kinds_ = np.asarray(found.classes_, dtype=np.int64)
        self._trees = boosted_trees([found])
        self.known_ = np.sort(self.judge(calibration)[0])
        return self

    def judge(self, inputs: F64) -> tuple[F64, NDArray[np.int64]]:
        """How strange windows are, −log P(healthy), and what kind they would be if they were; shapes (n,)."""
        raw = self._trees.predict(inputs)
        log_p = raw - logsumexp(raw, axis=1, keepdims=True)
        healthy = self.kinds_ == HEALTHY
        kind = self.kinds_[np.argmax(np.where(healthy, -np.inf, log_p), axis=1)]
        return -log_p[:, healthy][:, 0], kind

    def share(self, strange: F64) -> F64:
        """Share of healthy windows that are at least as strange, 0 .. 1, shape (n,)."""
        above = len(self.known_) - np.searchsorted(self.known_, strange, side="left")
        return np.asarray(above / (len(self.known_) + 1.0))


def strangeness_inputs(extended: F64, base: Baseline, spec: TrainingSpec) -> F64:
    """What the trees see: all features, and how far the regression lies beyond the range, as a logarithm and in its own
    standard deviations; shape (n, d + 11).

    Args:
        extended: of `Prepared`, shape (n, d).
    """
    nominal = np.log([spec.nominal[n] for n in CORE])
    away = base.centre[:, : len(CORE)] - nominal
    beyond = (np.abs(away) - np.log(spec.spread)) / base.scale[:, : len(CORE)]
    return np.asarray(np.nan_to_num(np.column_stack([extended, away, beyond, beyond.max(axis=1)])))
