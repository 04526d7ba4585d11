"""A small model of the paper's motor that several tests ask; simulated and trained once a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from servo_daemon.learning.examples.drawing import TrainingSpec, draw_parameters
from servo_daemon.learning.examples.training import TrainingSet, simulate_motors
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.training.fitting import train_model
from servo_daemon.simulate import PAPER_MOTOR

#: Windows of 2 s at 500 Hz.
SPEC = TrainingSpec(dict(PAPER_MOTOR), window_s=2.0, rate_hz=500.0)
#: Enough for some percent.
MOTORS = 300

Once = Callable[[str, Callable[[], Any]], Any]


def small_windows(once: Once) -> TrainingSet:
    """Of `MOTORS` motors, with faulty and foreign ones; `once`: the fixture."""

    def simulated() -> TrainingSet:
        return simulate_motors(SPEC, range(MOTORS), draw_parameters(SPEC, MOTORS), novel=True)

    windows: TrainingSet = once("windows", simulated)
    return windows


def small_model(once: Once) -> LearnedModel:
    """Trained on `small_windows`."""
    model: LearnedModel = once("model", lambda: train_model(SPEC, small_windows(once)))
    return model
