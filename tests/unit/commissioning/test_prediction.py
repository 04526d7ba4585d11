"""What a prediction names where the encoder stands: the shaft's doing or the encoder's."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from servo_daemon.commissioning.prediction import Prediction
from servo_daemon.commissioning.stop import Stop, StoppedError
from servo_daemon.commissioning.supervisor import Reading
from servo_daemon.plant.linear import linear_step

#: A winding that settles within a sample, of 1 ms.
MOTOR = {"R": 3.0, "L": 2.7e-3, "K": 0.07, "J": 1.4e-4, "B": 5e-5}
STEP_S, COUNT_RAD = 1e-3, 2e-3 * math.pi / 8.192


def prediction(peak_rad_s: float, voltage_V: float = 0.0) -> Prediction:
    return Prediction(MOTOR, STEP_S, COUNT_RAD, 0.006, 0.0, Reading(0.0, voltage_V, 0.0, 0.0), (peak_rad_s, 1.0))


def standing(voltage_V: Callable[[float], float], seconds: float) -> list[Reading]:
    """A shaft that stands under a voltage, V over s, held from sample to sample: its current, exactly."""
    settles = math.exp(-STEP_S * MOTOR["R"] / MOTOR["L"])
    out, i = [], 0.0
    for k in range(1, round(seconds / STEP_S)):
        before = voltage_V((k - 1) * STEP_S)
        i = before / MOTOR["R"] + (i - before / MOTOR["R"]) * settles
        out.append(Reading(k * STEP_S, voltage_V(k * STEP_S), i, 0.0))
    return out


def test_of_a_shaft_that_sticks_no_back_emf_is_seen_whatever_the_voltage_does() -> None:
    p = prediction(6.0)
    for r in standing(lambda t: 2.0 * math.sin(2 * math.pi * 180.0 * t), 0.2):
        p.check(r)
    assert p.named_stuck(Stop("motion_ended", "", 0.2)).reason == "hard_stop"


@pytest.mark.parametrize(("moved_rad", "reason"), [(0.0, "encoder_lost"), (4 * COUNT_RAD, "innovations")])
def test_an_encoder_that_moves_is_not_dead(moved_rad: float, reason: str) -> None:
    """A motor that turns backward, by voltage and current; by the encoder it stands from a moment on, or comes back."""
    p, (A, b) = prediction(20.0, -3.0), linear_step(MOTOR, STEP_S)
    state, shown_rad = np.zeros(3), 0.0
    with pytest.raises(StoppedError) as stopped:
        for k in range(1, 200):
            state = A @ state - 3.0 * b[:, 0]
            shown_rad = float(state[2]) if k < 60 else shown_rad + moved_rad
            p.check(Reading(k * STEP_S, -3.0, float(state[0]), shown_rad))
    assert stopped.value.stop.reason == reason
