"""A trained model: from the features of windows to parameters with calibrated intervals, or to a reason why not."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import BadInputError
from servo_daemon.learning import catalogue
from servo_daemon.learning.conformal import FEWEST_CALIBRATED, Intervals, calibrate
from servo_daemon.learning.drawing import TrainingSpec
from servo_daemon.learning.familiarity import LEAST_FAMILIARITY, Familiarity
from servo_daemon.learning.learners import Learner, fit_learner, make_learner, predict
from servo_daemon.learning.preparation import Preparation
from servo_daemon.learning.screening import Screening, screen
from servo_daemon.learning.targets import Target, baseline, bounded, coordinate_scale, decode, encode, natural
from servo_daemon.learning.training import TARGETS, TrainingSet
from servo_daemon.samples import F64

#: Shares of the motors: to calibrate with, and of the others to screen with.
_CALIBRATE, _SCREEN = 0.25, 0.2
#: Fewer give no useful model.
FEWEST_MOTORS = 100
#: An estimate beyond the trained range by more than this factor is declined.
_BEYOND_RANGE = 1.3
#: Of the features so many may be missing in a window.
_MOST_MISSING = 0.1

#: Told what is being done.
Say = Callable[[str], object]


@dataclass(frozen=True)
class Predictions:
    """Of n windows; m parameters in the order of `TARGETS`.

    Attributes:
        value, std, low, high: shape (n, m), SI units; std is 1 σ, low and high bound the 95 % interval.
        familiarity: shape (n,), 0 .. 1: share of training-like windows that are less familiar.
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
    """See the module; made by `train_model`.

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
        return Predictions(
            value,
            sigma,
            natural(coordinates - half, base.torque),
            natural(coordinates + half, base.torque),
            familiarity,
            self._declined(prepared.missing, value, base.known, familiarity),
            self.intervals.correlation,
        )

    def _declined(self, missing: F64, value: F64, known: NDArray[np.bool_], familiarity: F64) -> tuple[str, ...]:
        reasons = []
        for k in range(len(value)):
            outside = self._outside(value[k])
            if not known[k]:
                reasons.append("the window's motion determines no regression")
            elif missing[k] > _MOST_MISSING:
                reasons.append(f"{100 * missing[k]:.0f} % of the features cannot be had from this window")
            elif outside:
                reasons.append(f"{outside} lies outside what the model was trained on")
            elif familiarity[k] < LEAST_FAMILIARITY:
                reasons.append("the window is unlike those of the training")
            else:
                reasons.append("")
        return tuple(reasons)

    def _outside(self, value: F64) -> str:
        """Name of the parameter that lies furthest outside the trained range; "" if none does."""
        core = TARGETS[:-1]
        away = np.abs(np.log(value[: len(core)] / np.array([self.spec.nominal[n] for n in core])))
        worst = int(np.argmax(np.where(np.isfinite(away), away, np.inf)))
        return "" if away[worst] <= np.log(self.spec.spread * _BEYOND_RANGE) else core[worst]


def train_model(
    spec: TrainingSpec,
    windows: TrainingSet,
    *,
    target: Target = "correction",
    learner: Learner = "grnn",
    jobs: int = -1,
    say: Say | None = None,
) -> LearnedModel:
    """Screen, fit, calibrate.

    Args:
        windows: simulated ones of this spec, and measured ones.
        jobs: cores.
        say: told what is being done.

    Raises:
        BadInputError: too few motors with a usable window.
    """
    tell = say or (lambda _: None)
    began = time.perf_counter()
    base = baseline(windows.features, spec.nominal, spec.spread)
    wanted, scale = encode(target, windows.truth, base, spec.nominal), coordinate_scale(target, base)
    usable = base.known & np.isfinite(wanted).all(axis=1)
    windows, wanted = windows.only(usable), wanted[usable]
    y = bounded(target, wanted)  # few windows in which the regression is useless are not to rule the fit
    motors = np.unique(windows.motor)
    if len(motors) < FEWEST_MOTORS:
        raise BadInputError(f"{len(motors)} motors gave a usable window: {FEWEST_MOTORS} at least are needed")
    role = roles(windows.motor, spec.seed)
    fit = role != "calibrate"
    tell("screening the features")
    preparation = Preparation().fit(windows.features[fit])
    prepared = preparation.prepare(windows.features)
    X = prepared.learned
    screening = screen(X[fit], y[fit], role[fit] == "screen", jobs=jobs, seed=spec.seed)
    tell("fitting")
    kept = screening.kept
    fitted = fit_learner(make_learner(learner, jobs=jobs, seed=spec.seed), X[fit][:, kept], y[fit], windows.motor[fit])
    tell("calibrating")
    predicted, std = predict(fitted, X[~fit][:, kept])
    labels = windows.motor[~fit]
    # Few windows that were bounded for the fit count here as they are.
    intervals = calibrate(wanted[~fit], predicted, std, labels)
    tell_tales = np.flatnonzero(np.isin([catalogue.NAMES[k] for k in preparation.used_], catalogue.TELL_TALES))
    familiarity = Familiarity().fit(prepared.extended[fit], prepared.extended[~fit], tell_tales, spec.seed)
    facts = _facts(screening, len(motors), X.shape[1], np.abs(predicted - wanted[~fit]) * scale[usable][~fit])
    model = LearnedModel(spec, target, learner, preparation, kept, fitted, intervals, familiarity, facts)
    # What it declines promises nothing: the intervals are for what it accepts.
    accepted = model.predict(windows.features[~fit]).accepted
    if len(np.unique(labels[accepted])) >= FEWEST_CALIBRATED:
        intervals = calibrate(wanted[~fit][accepted], predicted[accepted], std[accepted], labels[accepted])
    facts |= {"accepted": float(accepted.mean()), "seconds": time.perf_counter() - began}
    return replace(model, intervals=intervals)


def roles(motor: NDArray[np.int64], seed: int) -> NDArray[np.str_]:
    """What each window is for, by its motor: "fit", "screen" or "calibrate"; measured ones (negative) only to fit."""
    names = np.unique(motor)
    draw = np.random.default_rng([seed, 3]).random(len(names))
    role = np.where(draw < _CALIBRATE, "calibrate", np.where(draw < _CALIBRATE + _SCREEN, "screen", "fit"))
    role[names < 0] = "fit"
    return np.asarray(role[np.searchsorted(names, motor)])


def _facts(screening: Screening, motors: int, features: int, error: F64) -> dict[str, Any]:
    """Held-out errors are those of motors that took part in nothing but the calibration."""
    return {
        "motors": motors,
        "features": features,
        "features_kept": len(screening.kept),
        "screening_loss": screening.loss,
        "median_error": {name: float(e) for name, e in zip(TARGETS, np.median(error, axis=0), strict=True)},
    }
