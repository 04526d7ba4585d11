"""A small model of the paper's motor that several tests ask; trained once."""

from __future__ import annotations

from functools import cache

from servo_daemon.learning.examples.drawing import TrainingSpec, draw_parameters
from servo_daemon.learning.examples.training import simulate_motors
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.training.fitting import train_model
from servo_daemon.simulate import PAPER_MOTOR

#: Windows of 2 s at 500 Hz.
SPEC = TrainingSpec(dict(PAPER_MOTOR), window_s=2.0, rate_hz=500.0)


@cache
def small_model(motors: int = 300) -> LearnedModel:
    """Good to some percent."""
    return train_model(SPEC, simulate_motors(SPEC, range(motors), draw_parameters(SPEC, motors), novel=True), jobs=1)
