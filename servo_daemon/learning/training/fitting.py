"""From windows with known parameters to a model: screen, fit, calibrate."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import BadInputError
from servo_daemon.learning import Learner
from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.examples.targets import Baseline, Target, baseline, bounded, coordinate_scale, encode
from servo_daemon.learning.examples.training import FAULTY, FOREIGN, HEALTHY, TARGETS, TrainingSet
from servo_daemon.learning.features.preparation import Preparation
from servo_daemon.learning.learners.conformal import FEWEST_CALIBRATED, Intervals, calibrate
from servo_daemon.learning.learners.familiarity import Familiarity
from servo_daemon.learning.learners.learners import fit_learner, make_learner, predict
from servo_daemon.learning.learners.screening import Screening, screen
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.model.novelty import Looks, Novelty
from servo_daemon.samples import F64

#: Shares of the motors: to calibrate with, and of the others to screen with.
_CALIBRATE, _SCREEN = 0.25, 0.2
#: Fewer give no useful model.
FEWEST_MOTORS = 100

#: Told what is being done.
Say = Callable[[str], object]


@dataclass(frozen=True)
class _Usable:
    """Windows that can be learned from, and what of them: m targets.

    Attributes:
        windows, base: n of them, with a regression.
        wanted, scale: shape (n, m), targets, and coordinates per unit of these.
        role: shape (n,), see `roles`.
    """

    windows: TrainingSet
    base: Baseline
    wanted: F64
    scale: F64
    role: NDArray[np.str_]

    def healthy(self, which: NDArray[np.bool_]) -> _Usable:
        """Some of the windows, of these the healthy ones."""
        return self.only(which & (self.windows.kind == HEALTHY))

    def only(self, which: NDArray[np.bool_]) -> _Usable:
        """Some of the windows."""
        base, wanted, scale = self.base.only(which), self.wanted[which], self.scale[which]
        return _Usable(self.windows.only(which), base, wanted, scale, self.role[which])


def train_model(
    spec: TrainingSpec,
    windows: TrainingSet,
    *,
    target: Target = "correction",
    learner: Learner = "grnn",
    say: Say | None = None,
) -> LearnedModel:
    """Screen, fit, calibrate.

    Args:
        windows: simulated ones of this spec, novel ones among them, and measured ones.
        say: told what is being done.

    Raises:
        BadInputError: too few motors with a usable window, or no novel ones.
    """
    tell = say or (lambda _: None)
    began = time.perf_counter()
    everything = _usable(spec, windows, target)
    fit, held = (everything.healthy((everything.role == "calibrate") == c) for c in (False, True))
    tell("screening the features")
    preparation = Preparation().fit(fit.windows.features)
    X = preparation.transform(fit.windows.features)
    y = bounded(target, fit.wanted)  # where the regression is useless, it is not to rule
    screening = screen(X, y, fit.role == "screen", seed=spec.seed)
    tell("fitting")
    kept = screening.kept
    fitted = fit_learner(make_learner(learner, seed=spec.seed), X[:, kept], y, fit.windows.motor)
    tell("calibrating")
    predicted = predict(fitted, preparation.transform(held.windows.features)[:, kept])
    intervals = _intervals(held, predicted, held.role == "calibrate")
    declines = _declines(spec, preparation, everything)
    uncalibrated = LearnedModel(spec, target, learner, preparation, kept, fitted, intervals, *declines, {})
    model = _calibrated(uncalibrated, held, predicted)
    facts = _facts(screening, everything, np.abs(predicted[0] - held.wanted) * held.scale, len(preparation.used_))
    return replace(model, facts=facts | _abstains(model, everything) | {"seconds": time.perf_counter() - began})


def _calibrated(model: LearnedModel, held: _Usable, predicted: tuple[F64, F64]) -> LearnedModel:
    """With intervals for what it accepts: what it declines promises nothing."""
    accepted = model.predict(held.windows.features).accepted
    if len(np.unique(held.windows.motor[accepted])) < FEWEST_CALIBRATED:
        return model
    return replace(model, intervals=_intervals(held, predicted, accepted))


def _intervals(held: _Usable, predicted: tuple[F64, F64], which: NDArray[np.bool_]) -> Intervals:
    """From some of the held-out windows; few that would have been bounded for the fit count here as they are."""
    value, std = predicted
    return calibrate(held.wanted[which], value[which], std[which], held.windows.motor[which])


def _usable(spec: TrainingSpec, windows: TrainingSet, target: Target) -> _Usable:
    """Raises BadInputError where that is too little to learn from."""
    base = baseline(windows.features, spec.nominal, spec.spread)
    wanted, scale = encode(target, windows.truth, base, spec.nominal), coordinate_scale(target, base)
    role = roles(windows.motor, spec.seed)
    found = _Usable(windows, base, wanted, scale, role).only(base.known & np.isfinite(wanted).all(axis=1))
    motors = len(np.unique(found.windows.motor[found.windows.kind == HEALTHY]))
    if motors < FEWEST_MOTORS:
        raise BadInputError(f"{motors} motors gave a usable window: {FEWEST_MOTORS} at least are needed")
    if not {FAULTY, FOREIGN} <= set(found.windows.kind.tolist()):
        raise BadInputError("no windows with a fault or of motors outside the range: simulate them with novel=True")
    return found


def _declines(spec: TrainingSpec, preparation: Preparation, of: _Usable) -> tuple[Familiarity, Novelty]:
    """What the model declines by."""
    looks = Looks(preparation.prepare(of.windows.features).extended, of.base)
    kind, held = of.windows.kind, of.role == "calibrate"
    fit, calibration = ~held & (kind == HEALTHY), looks.only(held & (kind == HEALTHY))
    return (
        Familiarity().fit(looks.extended[fit], calibration.extended, spec.seed),
        Novelty().fit(spec, looks.only(~held), of.windows.truth[~held], kind[~held], calibration),
    )


def roles(motor: NDArray[np.int64], seed: int) -> NDArray[np.str_]:
    """What each window is for, by its motor: "fit", "screen" or "calibrate"; measured ones (negative) only to fit."""
    names = np.unique(motor)
    draw = np.random.default_rng([seed, 3]).random(len(names))
    role = np.where(draw < _CALIBRATE, "calibrate", np.where(draw < _CALIBRATE + _SCREEN, "screen", "fit"))
    role[names < 0] = "fit"
    return np.asarray(role[np.searchsorted(names, motor)])


def _facts(screening: Screening, of: _Usable, error: F64, features: int) -> dict[str, Any]:
    """Held-out errors are those of motors that took part in nothing but the calibration."""
    return {
        "motors": len(np.unique(of.windows.motor[of.windows.kind == HEALTHY])),
        "features": features,
        "features_kept": len(screening.kept),
        "screening_loss": screening.loss,
        "median_error": {name: float(e) for name, e in zip(TARGETS, np.median(error, axis=0), strict=True)},
    }


def _abstains(model: LearnedModel, of: _Usable) -> dict[str, float]:
    """Which share the model accepts of the windows of calibration motors, healthy and novel."""
    held = of.windows.only(of.role == "calibrate")
    accepted, kind = model.predict(held.features).accepted, held.kind
    shares = {"accepted": HEALTHY, "accepted_faulty": FAULTY, "accepted_foreign": FOREIGN}
    return {name: float(accepted[kind == k].sum() / max(np.count_nonzero(kind == k), 1)) for name, k in shares.items()}
