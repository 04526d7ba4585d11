"""Where a running daemon's learned models come from: kept ones, trained ones, none; and what is published meanwhile."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.config import parse_config
from servo_daemon.daemon import learning_coordinator
from servo_daemon.errors import BadInputError
from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.model import cache
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.model.model_file import save_model
from servo_daemon.learning.training import background
from servo_daemon.published.snapshot import EstimatorView
from servo_daemon.simulate import DEFAULT_NOMINAL
from tests.daemon_rig import Rig, starter
from tests.learned_models import Once, small_model

NOMINAL = {n: v for n, v in DEFAULT_NOMINAL.items() if n != "J_m"}
SPEC = TrainingSpec(NOMINAL, window_s=2.0, rate_hz=1000.0)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., Rig]]:
    monkeypatch.setattr(cache, "_directory", lambda: tmp_path / "models")
    monkeypatch.setattr(learning_coordinator, "_TURN_S", 0.01)
    monkeypatch.setattr(learning_coordinator, "TRAIN_AFTER_S", 0.0)
    with starter(monkeypatch) as begin:
        yield begin


@pytest.fixture(scope="module")
def model(once: Once) -> LearnedModel:
    """Of another motor, whose windows are half as dense: what it says does not matter here."""
    return replace(small_model(once), spec=SPEC)


def config(*, nominal: dict[str, float] | None = None, refresh: bool = True, **learning: Any) -> Any:
    estimation = {"refresh": refresh, "refresh_window_s": 2.0, "refresh_every_s": 2.0}
    drive = {"name": "axis1", "driver": "fed", "nominal": NOMINAL if nominal is None else nominal}
    return parse_config({"drive": [drive | {"estimation": estimation}], "learning": learning})


def grnn(rig: Rig) -> EstimatorView | None:
    estimate = rig.snapshot().estimate
    return None if estimate is None else estimate.estimators.get("grnn")


def until(rig: Rig, condition: Callable[[EstimatorView], Any], what: str) -> EstimatorView:
    """Feeds until it holds."""

    def holds() -> bool:
        rig.driver().feed(100)
        view = grnn(rig)
        return view is not None and bool(condition(view))

    rig.until(holds, what)
    view = grnn(rig)
    assert view is not None
    return view


def caught_up(rig: Rig) -> bool:
    """Whether every sample has been processed or, where this machine is slow, dropped."""
    snapshot = rig.snapshot()
    done = 0 if snapshot.estimate is None else snapshot.estimate.samples
    return done + snapshot.counters["samples_lost"] >= rig.driver().fed


class Trained:
    """In place of the real training: does what the test says, one step with every look at it."""

    steps: tuple[int | str | LearnedModel, ...] = ()
    begun: list[TrainingSpec]
    stopped = 0

    def __init__(self, spec: TrainingSpec, motors: int, nice: int = 15, learner: str = "grnn") -> None:
        Trained.begun.append(spec)
        self.done, self.error, self.running = 0, "", True
        self._left = list(Trained.steps)
        self._model: LearnedModel | None = None

    def model(self) -> LearnedModel | None:
        if self._left:
            step = self._left.pop(0)
            if isinstance(step, int):
                self.done = step
                return None
            self.running = False
            self._model, self.error = (None, step) if isinstance(step, str) else (step, "")
        return self._model

    def stop(self) -> None:
        self.running = False
        Trained.stopped += 1


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> type[Trained]:
    monkeypatch.setattr(background, "BackgroundTraining", Trained)
    Trained.steps, Trained.begun, Trained.stopped = (), [], 0
    return Trained


def test_for_a_model_of_another_drive_scikit_learn_is_not_loaded(
    model: LearnedModel, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    save_model(model, tmp_path / "other.model")
    monkeypatch.setattr(cache, "_directory", lambda: tmp_path)
    monkeypatch.setitem(sys.modules, "servo_daemon.learning.model.model_file", None)
    assert cache.kept_model(replace(SPEC, effects=("coulomb_friction",)), "grnn") is None
    with pytest.raises(ImportError):
        cache.kept_model(SPEC, "grnn")


def test_a_kept_model_is_taken(start: Callable[..., Rig], model: LearnedModel, training: type[Trained]) -> None:
    save_model(model, cache.model_path(replace(SPEC, seed=5)))  # trained by somebody else, otherwise
    rig = start(config())
    view = until(rig, lambda v: v.parameters, "an estimate of the learned model")
    assert view.detail["mode"] in ("shadow", "trusted")
    assert rig.kinds().count("model_learned") == 1
    assert training.begun == []


def test_training_shows_how_far_it_is_and_then_works(
    start: Callable[..., Rig], model: LearnedModel, training: type[Trained]
) -> None:
    training.steps = (0, *(40,) * 200, model)
    rig = start(config(motors=200))
    view = until(rig, lambda v: v.detail.get("motors_done") == 40, "progress of the training")
    assert view.parameters == {}
    assert view.detail == {"mode": "training", "motors_done": 40, "motors": 200}
    until(rig, lambda v: v.parameters, "an estimate of the trained model")
    (spec,) = training.begun
    assert (spec.rate_hz, spec.window_s, dict(spec.nominal)) == (1000.0, 2.0, NOMINAL)


def test_without_a_model_it_says_why(start: Callable[..., Rig], training: type[Trained]) -> None:
    training.steps = (3, "too few motors gave a usable window")
    view = until(start(config()), lambda v: v.detail["mode"] == "unavailable", "the end of the training")
    assert view.detail["reason"] == "too few motors gave a usable window"
    assert len(training.begun) == 1  # not again and again


def test_no_datasheet_no_training(start: Callable[..., Rig], training: type[Trained]) -> None:
    view = until(start(config(nominal={"R": 1.0})), lambda v: v.detail["mode"] == "unavailable", "no model")
    assert "nominal L, K, J, B missing" in str(view.detail["reason"])
    assert training.begun == []


def test_training_can_be_forbidden(start: Callable[..., Rig], training: type[Trained]) -> None:
    view = until(start(config(train=False)), lambda v: v.detail["mode"] == "unavailable", "no model")
    assert "[learning] train is false" in str(view.detail["reason"])
    assert training.begun == []


def test_the_first_seconds_are_not_worth_it(
    start: Callable[..., Rig], training: type[Trained], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning_coordinator, "TRAIN_AFTER_S", 1000.0)
    view = until(start(config()), lambda v: "training begins" in str(v.detail.get("reason")), "waiting")
    assert view.detail["mode"] == "waiting"
    assert training.begun == []


def test_switched_off_there_is_nothing(start: Callable[..., Rig], training: type[Trained]) -> None:
    rig = start(config(refresh=False))
    rig.driver().feed(3000)
    rig.until_samples(3000)
    assert grnn(rig) is None
    assert training.begun == []


def test_a_damaged_file_is_passed_over(start: Callable[..., Rig], model: LearnedModel, tmp_path: Path) -> None:
    save_model(model, tmp_path / "models" / "good.model")
    (tmp_path / "models" / "newer.model").write_bytes(b"PK nothing of the kind")
    found = cache.kept_model(SPEC, "grnn")
    assert found is not None
    assert found.spec == SPEC
    assert cache.kept_model(SPEC, "boosting") is None
    assert cache.kept_model(replace(SPEC, effects=("coulomb_friction",)), "grnn") is None
    with pytest.raises(BadInputError):
        cache.kept_model(replace(SPEC, window_s=20.0), "grnn")


def test_stopping_ends_the_training(start: Callable[..., Rig], training: type[Trained]) -> None:
    training.steps = (1,) * 100_000
    rig = start(config())
    until(rig, lambda v: v.detail["mode"] == "training", "the training")
    rig.daemon.stop()
    assert training.stopped == 1


def test_a_reset_keeps_the_learned_model(start: Callable[..., Rig], model: LearnedModel) -> None:
    save_model(model, cache.model_path(SPEC))
    rig = start(config())
    until(rig, lambda v: v.parameters and v.detail["windows"] >= 3, "estimates of the learned model")
    rig.until(lambda: caught_up(rig), "nothing waits to be processed")
    rig.runtime().request_reset()
    rig.until(lambda: rig.snapshot().estimate is None, "a new beginning")
    until(rig, lambda v: v.parameters, "an estimate after the reset")
    assert rig.kinds().count("model_learned") == 1
