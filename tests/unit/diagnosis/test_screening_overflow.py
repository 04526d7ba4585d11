"""A trace that leaves the range of numbers: a joint sampled far too slowly for the spring that it supposes."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.diagnosis.missing.signals import motion_of
from servo_daemon.diagnosis.screening.regression import Regression
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.model_discrepancy import seen_missing
from servo_daemon.diagnosis.trial.trial import first_trial
from servo_daemon.identification.output_error import Recording
from servo_daemon.plant.columns.screening import Trace
from servo_daemon.samples import make_block

J, B, TC, INNER = 0.2, 0.3, 0.3, 50


def joint() -> Recording:
    """A robot's joint at 42 Hz with jitter, moved and held in turn, with dry friction."""
    random = np.random.default_rng(5)
    time = np.cumsum(random.gamma(4.0, 1 / 168.0, 1100))
    torque = np.repeat(random.uniform(-1.0, 1.0, 55) * (np.arange(55) % 3 == 0), 20)
    w = x = 0.0
    angle = []
    for drive, h in zip(torque, np.diff(time, append=time[-1] + 0.02), strict=True):
        angle.append(x)
        for _ in range(INNER):
            pushed = drive - B * w
            free = w + h / INNER * (pushed - TC * np.sign(w if w else pushed)) / J
            w = 0.0 if (w == 0.0 and abs(drive) < TC) or w * free < 0.0 else free
            x += w * h / INNER
    return Recording("joint", make_block(time, torque_Nm=torque, position_rad=np.round(np.array(angle), 3)))


def test_a_trace_without_a_sum_of_squares_explains_nothing() -> None:
    data = Data.of([joint()], {}, (), 0.5)
    missing = seen_missing(data, first_trial(data, (), {}))
    motion = motion_of(missing)
    far = np.exp(np.linspace(0.0, 500.0, len(motion.t)))  # a spring too stiff for this sampling, before it overflows
    traces = [Trace(torque=np.where(motion.rest, 0.0, motion.direction)), Trace(torque=far)]
    equations = Regression.of(missing, motion, traces, [])
    friction, spring = equations.coefficients([0, 1])
    assert spring == 0.0 and friction == pytest.approx(equations.coefficients([0])[0]) != 0.0
    assert equations.errors([0, 1]) == pytest.approx(equations.errors([0]))
