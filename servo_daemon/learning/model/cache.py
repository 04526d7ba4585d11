"""Trained models kept for the next time: the one place that knows where."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.errors import BadInputError
from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.examples.drive import same_rate
from servo_daemon.learning.model.manifest import trained_as
from servo_daemon.plant.compiler import cache_directory

if TYPE_CHECKING:
    from servo_daemon.learning.model.model import LearnedModel

log = logging.getLogger(__name__)


def model_path(spec: TrainingSpec) -> Path:
    """Where the model of this training is kept: drives of one datasheet, model, rate and set of signals share it."""
    text = json.dumps(asdict(spec) | {"nominal": dict(spec.nominal)}, sort_keys=True)
    return _directory() / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.model"


def _directory() -> Path:
    return cache_directory() / "models"


def cached_model(spec: TrainingSpec, motors: int, learner: str | None = None) -> LearnedModel | None:
    """The kept model of this training, if there is one that this version can use, of at least so many motors.

    Args:
        learner: that it must be of; None: any.
    """
    from servo_daemon.learning.model.model_file import load_model

    path = model_path(spec)
    if not path.exists():
        return None
    try:
        model = load_model(path, own=True)
    except BadInputError as error:
        log.info("%s: training it again", error)
        return None
    fits = model.spec == spec and learner in (None, model.learner)
    return model if fits and model.facts.get("motors_drawn", 0) >= motors else None


def kept_model(wanted: TrainingSpec, learner: str) -> LearnedModel | None:
    """The newest kept model of this learner that can be asked about this drive's windows, whoever trained it and with
    how many motors; None: there is none."""
    for path in sorted(_directory().glob("*.model"), key=_changed, reverse=True):
        try:
            spec, trained = trained_as(path)
            if trained == learner and serves(spec, wanted):
                from servo_daemon.learning.model.model_file import load_model  # takes a second: scikit-learn

                return load_model(path, own=True)
        except BadInputError as error:
            log.info("%s", error)
    return None


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # removed meanwhile
        return 0.0


def serves(own: TrainingSpec, wanted: TrainingSpec) -> bool:
    """Whether a model of the one training can be asked about windows of the other: the same motor, signals and length,
    nearly the same rate; what is merely drawn (supply, encoder) may differ."""
    same = (own.effects, own.channels, own.window_s) == (wanted.effects, wanted.channels, wanted.window_s)
    return same and same_rate(own.rate_hz, wanted.rate_hz) and dict(own.nominal) == dict(wanted.nominal)


def obtain_model(
    spec: TrainingSpec, motors: int, train: Callable[[], LearnedModel], own: TrainingSpec | None = None
) -> tuple[LearnedModel, bool]:
    """The kept model, or one that `train` makes, which is then kept.

    Args:
        own: what `servo-daemon train` would train for this drive: a model of that comes first, if it serves.

    Returns:
        the model, and whether it was trained now.
    """
    from servo_daemon.learning.model.model_file import save_model

    kept = cached_model(own, motors) if own is not None and serves(own, spec) else None
    kept = kept or cached_model(spec, motors)
    if kept is not None:
        return kept, False
    model = train()
    try:
        save_model(model, model_path(spec))
    except BadInputError as error:  # it serves this time
        log.warning("%s", error)
    return model, True
