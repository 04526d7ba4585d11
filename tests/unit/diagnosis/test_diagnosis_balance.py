"""What the shaft's balance names of a current that is a mean, in coarse steps, with the shaft at rest now and then.

The motion is given and the current that it needs is computed from it on a fine grid: nothing is simulated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.diagnosis.inverse.inverse import full_data_values
from servo_daemon.diagnosis.inverse.rows import balance_rows
from servo_daemon.diagnosis.inverse.search import Found, search_balance
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.identification.output_error import Recording
from servo_daemon.samples import F64, make_block

K, J, B, TORQUE = 0.05, 2e-5, 6e-5, 6e-4
FINE, SECONDS, STEP_A = 4000, 20.0, 0.012

#: Torque, N·m, of angle and speed.
Load = Callable[[F64, F64], F64]


def rests_between(load: Load) -> tuple[F64, F64]:
    """Trapezoids of speed to and fro, which end in the same four places again and again; with friction anywhere."""
    t = np.arange(round(SECONDS * FINE)) / FINE
    number = (t // 0.9).astype(int)
    sizes = np.random.default_rng(1).uniform(0.7, 1.1, number[-1] + 1) if load is sticking else np.ones(number[-1] + 1)
    way = np.array([45.0, -31.5, 22.5, -36.0])[number % 4] * sizes[number]
    s = t % 0.9
    omega = way * np.clip(np.minimum(s / 0.15, (0.65 - s) / 0.15), 0.0, 1.0)
    return np.cumsum(omega) / FINE, omega


def found(load: Load, hz: int, step_A: float) -> Found | None:
    """Of means over the intervals that end at the samples, rounded to steps."""
    theta, omega = rests_between(load)
    current = (J * np.gradient(omega) * FINE + B * omega + load(theta, omega)) / K
    current += np.random.default_rng(3).normal(0.0, 0.003, len(current))
    each = FINE // hz
    means = current.reshape(-1, each).mean(axis=1)
    means = np.round(means / step_A) * step_A if step_A else means
    at = np.arange(len(means)) * each + each - 1
    position = np.round(theta[at] * 16384 / (2 * math.pi)) * 2 * math.pi / 16384
    block = make_block((at + 1) / FINE, current_A=means, position_rad=position)
    recordings = (Recording("means", replace(block, current_mean=True)),)
    rows = balance_rows(Data.of(recordings, {}, (), segment_length_s(recordings)), (), {"K": K, "J": J, "B": B})
    assert rows is not None
    return search_balance(rows)


def cogging(theta: F64, _: F64) -> F64:
    return TORQUE * np.sin(7 * theta + 0.4)


def sticking(theta: F64, omega: F64) -> F64:
    """Dry friction; what holds the shaft at rest depends on the place in which it has come to rest."""
    return np.where(omega == 0.0, 0.9 * TORQUE * np.sin(40.0 * theta), TORQUE * np.sign(omega))


@pytest.mark.parametrize(
    ("load", "hz", "step_A", "name"),
    [
        (cogging, 200, 0.0, "cogging_torque"),  # at speed 1.6 rad of the wave pass in an interval
        (cogging, 500, STEP_A, "cogging_torque"),  # at rest a reading is off by the same in the same place
        (sticking, 500, STEP_A, "coulomb_friction"),
    ],
)
def test_one_cause_is_named_and_nothing_beside_it(load: Load, hz: int, step_A: float, name: str) -> None:
    named = found(load, hz, step_A)
    assert named is not None
    assert [e for torque in named.explained.torques for e in torque.effects] == [name]
    values = full_data_values(named.explained)
    size = "Tcog" if name == "cogging_torque" else "Tc"
    for parameter, true in ((size, TORQUE), ("J", J), ("B", B)):
        std = values.std[parameter]
        assert std is not None and 3.0 * std < true
        assert abs(values.value[parameter] - true) < 3.0 * std + 2e-3 * true  # and the corners of the motion
    assert values.value.get("n_cog", 7.0) == 7.0 and values.value.get("phi_cog", 0.4) == pytest.approx(0.4, abs=0.05)


def test_steps_of_the_reading_are_no_cause() -> None:
    assert found(lambda theta, _: 0.0 * theta, 500, STEP_A) is None
