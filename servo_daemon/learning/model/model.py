"""A trained model: from the features of windows to parameters with calibrated intervals, or to a reason why not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servo_daemon.learning import Learner
from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.examples.targets import Target, baseline, coordinate_scale, decode, natural
from servo_daemon.learning.examples.training import FAULTY, TARGETS
from servo_daemon.learning.features import catalogue
from servo_daemon.learning.features.preparation import Preparation
from servo_daemon.learning.learners.conformal import Intervals
from servo_daemon.learning.learners.familiarity import LEAST_FAMILIARITY, Familiarity
from servo_daemon.learning.learners.learners import predict
from servo_daemon.learning.model.novelty import MOST_NOVEL, Looks, Novelty
from servo_daemon.samples import F64

#: An estimate beyond the trained range by more than this factor is declined, however familiar the window looks.
_BEYOND_RANGE = 2.0
#: Of the features so many may be missing in a window.
_MOST_MISSING = 0.1
_LOOKS_FAULTY = "the window looks like one with a fault of the measuring"
_LOOKS_FOREIGN = "the motor looks like one outside what the model was trained on"


@dataclass(frozen=True)
class Predictions:
    """Of n windows; m parameters in the order of `TARGETS`.

    Attributes:
        value, std, low, high: shape (n, m), SI units; std is 1 σ, low and high bound the 95 % interval.
        familiarity: shape (n,), 0 .. 1: share of healthy windows of further motors within the range that are less
            familiar, or stranger.
        declined: for each window why there is no estimate; "" where there is one.
        correlation: of the errors of logarithms (of friction itself), shape (m, m).
    """

    value: F64
    std: F64
    low: F64
    high: F64
    familiarity: F64
    declined: tuple[str, ...]
    correlation: F64

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """Shape (n,)."""
        return np.array([not reason for reason in self.declined], dtype=bool)


@dataclass(frozen=True)
class LearnedModel:
    """Everything that a prediction needs; made by `fitting.train_model`.

    Attributes:
        spec: what it was trained on.
        target, learner: how.
        kept: indices of the prepared features that the learner takes.
        facts: for people: motors, held-out errors, what screening cost, times.
    """

    spec: TrainingSpec
    target: Target
    learner: Learner
    preparation: Preparation
    kept: NDArray[np.intp]
    estimator: Any
    intervals: Intervals
    familiarity: Familiarity
    novelty: Novelty
    facts: Mapping[str, Any]

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Of the features that the learner takes."""
        return tuple(catalogue.NAMES[k] for k in self.preparation.used_[self.kept])

    def predict(self, features: F64) -> Predictions:
        """Estimates for windows.

        Args:
            features: shape (n, features), from `features.compute_features`.
        """
        base = baseline(features, self.spec.nominal, self.spec.spread)
        prepared = self.preparation.prepare(features)
        y, std = predict(self.estimator, prepared.learned[:, self.kept])
        scale = coordinate_scale(self.target, base)
        coordinates = decode(self.target, y, base, self.spec.nominal)
        half, one = self.intervals.half_width(std) * scale, self.intervals.std(std) * scale
        value = natural(coordinates, base.torque)
        sigma = np.column_stack([value[:, :-1] * one[:, :-1], one[:, -1] * base.torque])
        familiarity = self.familiarity.score(prepared.extended)
        novel, kind = self.novelty.judge(Looks(prepared.extended, base))
        usual = self.novelty.share(novel)
        looks = np.where(kind == FAULTY, _LOOKS_FAULTY, _LOOKS_FOREIGN)
        unlike = np.where(familiarity < LEAST_FAMILIARITY, "the window is unlike those of the training", "")
        return Predictions(
            value,
            sigma,
            natural(coordinates - half, base.torque),
            natural(coordinates + half, base.torque),
            np.minimum(familiarity, usual),
            self._declined(prepared.missing, value, base.known, np.where(usual < MOST_NOVEL, looks, unlike)),
            self.intervals.correlation,
        )

    def _declined(
        self, missing: F64, value: F64, known: NDArray[np.bool_], unlike: NDArray[np.str_]
    ) -> tuple[str, ...]:
        """Reasons, the plainest first; unlike: shape (n,), what a window looks like if not like the training."""
        reasons = []
        for k in range(len(value)):
            outside = self._outside(value[k])
            if not known[k]:
                reasons.append("the window's motion determines no regression")
            elif missing[k] > _MOST_MISSING:
                reasons.append(f"{100 * missing[k]:.0f} % of the features cannot be had from this window")
            elif outside:
                reasons.append(f"{outside} lies outside what the model was trained on")
            else:
                reasons.append(str(unlike[k]))
        return tuple(reasons)

    def _outside(self, value: F64) -> str:
        """Name of the parameter that lies furthest outside the trained range; "" if none does."""
        core = TARGETS[:-1]
        away = np.abs(np.log(value[: len(core)] / np.array([self.spec.nominal[n] for n in core])))
        worst = int(np.argmax(np.where(np.isfinite(away), away, np.inf)))
        return "" if away[worst] <= np.log(self.spec.spread * _BEYOND_RANGE) else core[worst]
