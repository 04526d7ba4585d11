"""Whether a window shows a fault of the measuring, or a motor outside the range that a model was trained for.

`familiarity` asks whether a window is unlike all of the training. One with a late current is not, nor one of a motor a
little too heavy: they are like windows of other motors, and the estimates are wrong. So such windows are made on
purpose (`faults`, `drawing.draw_outside`) and boosted trees (Friedman, *Annals of Statistics* 29, 2001) learn to tell
the three kinds apart. How novel a window must be to be declined is not learned but read off healthy motors that took
no part in it, as in `conformal`: a further healthy motor's is then declined with a probability of `MOST_NOVEL`.

Where a motor lies is asked of an estimate of its own. The learner has seen motors within the range only and draws all
others towards it; the regression is off by tens of percent where a motion tells little. A linear correction of the
regression (ridge) that has seen motors outside, too, draws none of them in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from servo_daemon.learning.examples.drawing import CORE, TrainingSpec
from servo_daemon.learning.examples.targets import Baseline, bounded, encode
from servo_daemon.learning.examples.training import FAULTY, HEALTHY
from servo_daemon.learning.learners.trees import boosted_trees
from servo_daemon.samples import F64

#: So large a share of healthy windows is declined for looking novel: with the other reasons less than 5 %.
MOST_NOVEL = 0.035
#: Four times as many tell faults no better.
_ROUNDS, _RATE, _FEATURES_TRIED = 60, 0.12, 0.3


#: Of the ridge; chosen by leave-one-out error.
_PENALTIES = np.logspace(-2, 4, 13)


@dataclass(frozen=True)
class Looks:
    """What n windows look like.

    Attributes:
        extended: of `Prepared`, shape (n, d).
        base: their regressions.
    """

    extended: F64
    base: Baseline

    def only(self, which: NDArray[np.bool_]) -> Looks:
        """Some of the windows."""
        return Looks(self.extended[which], self.base.only(which))


class Novelty(BaseEstimator):  # type: ignore[misc]  # scikit-learn is untyped
    """Boosted trees that tell healthy windows from faulty ones and from motors outside the range of the training.

    Attributes:
        slope_, start_: of the correction of the regression's R, L, K, J, B, in its own units, shapes (d, 5) and (5,).
        known_: of the calibration windows, sorted, shape (n,).
        kinds_: what the trees' outputs stand for, shape (3,).
    """

    def fit(self, spec: TrainingSpec, looks: Looks, truth: F64, kind: NDArray[np.int64], calibration: Looks) -> Novelty:
        """Windows of all kinds, their motors' parameters in the order of `TARGETS`, shape (n, m), which kind they are,
        shape (n,), and healthy windows of other motors."""
        from sklearn.ensemble import HistGradientBoostingClassifier

        self._nominal, self._range = np.log([spec.nominal[n] for n in CORE]), float(np.log(spec.spread))
        self._fit_correction(looks.only(kind != FAULTY), truth[kind != FAULTY], spec)
        found = HistGradientBoostingClassifier(
            learning_rate=_RATE,
            max_iter=_ROUNDS,
            max_features=_FEATURES_TRIED,
            early_stopping=False,
            random_state=spec.seed,
        ).fit(self._inputs(looks), kind)
        self.kinds_ = np.asarray(found.classes_, dtype=np.int64)
        self._trees = boosted_trees([found])
        self.known_ = np.sort(self.judge(calibration)[0])
        return self

    def _fit_correction(self, looks: Looks, truth: F64, spec: TrainingSpec) -> None:
        from sklearn.linear_model import RidgeCV

        wanted = bounded("correction", encode("correction", truth, looks.base, spec.nominal))[:, : len(CORE)]
        found = RidgeCV(_PENALTIES).fit(looks.extended, wanted)
        self.slope_, self.start_ = np.asarray(found.coef_.T), np.asarray(found.intercept_)

    def judge(self, looks: Looks) -> tuple[F64, NDArray[np.int64]]:
        """How novel windows are, −log P(healthy), and what kind they would be if they were; shapes (n,)."""
        raw = self._trees.predict(self._inputs(looks))
        raw -= raw.max(axis=1, keepdims=True)
        log_p = raw - np.log(np.exp(raw).sum(axis=1, keepdims=True))
        healthy = self.kinds_ == HEALTHY
        kind = self.kinds_[np.argmax(np.where(healthy, -np.inf, log_p), axis=1)]
        return -log_p[:, healthy][:, 0], kind

    def _inputs(self, looks: Looks) -> F64:
        """What the trees see: all features; how far the regression lies beyond the range, as a logarithm and in its own
        standard deviations; where the motor lies when that is corrected; shape (n, d + 17)."""
        own = slice(len(CORE))
        centre, scale = looks.base.centre[:, own] - self._nominal, looks.base.scale[:, own]
        beyond = (np.abs(centre) - self._range) / scale
        at = centre + (looks.extended @ self.slope_ + self.start_) * scale
        furthest = np.abs(at).max(axis=1) - self._range
        columns = (looks.extended, centre, beyond, beyond.max(axis=1), at, furthest)
        return np.asarray(np.nan_to_num(np.column_stack(columns)))

    def share(self, novel: F64) -> F64:
        """Share of healthy windows that are at least as novel, 0 .. 1, shape (n,)."""
        above = len(self.known_) - np.searchsorted(self.known_, novel, side="left")
        return np.asarray(above / (len(self.known_) + 1.0))
