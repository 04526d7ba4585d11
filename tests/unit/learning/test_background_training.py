"""Training beside a daemon: a process of its own, its progress, its end, and a kept model."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import pytest

from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.training.background import BackgroundTraining
from servo_daemon.simulate import PAPER_MOTOR

SPEC = TrainingSpec(dict(PAPER_MOTOR), window_s=2.0, rate_hz=250.0)


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)


def finished(training: BackgroundTraining, seconds: float = 500.0) -> BackgroundTraining:
    deadline = time.monotonic() + seconds
    while training.running and time.monotonic() < deadline:
        training.model()
        time.sleep(0.05)
    return training


@pytest.mark.slow
@pytest.mark.timeout(600)  # at low priority on a machine that others use
def test_a_model_comes_and_is_kept() -> None:
    training = BackgroundTraining(SPEC, 160)
    assert training.model() is None
    assert training.running
    assert finished(training).error == ""
    model = training.model()
    assert model is not None
    assert model.spec == SPEC
    assert training.done == 160
    again = BackgroundTraining(SPEC, 160)
    assert not again.running
    assert again.model() is not None


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_too_few_motors_are_told() -> None:
    training = finished(BackgroundTraining(dataclasses.replace(SPEC, seed=1), 20))
    assert "100 at least" in training.error
    assert training.model() is None


def test_it_can_be_stopped() -> None:
    training = BackgroundTraining(dataclasses.replace(SPEC, seed=2), 100_000)
    training.stop()
    assert not training.running
    assert training.error == "stopped"
    assert training.model() is None
