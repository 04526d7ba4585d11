"""A rotor that its controller drags slowly over its detents: what the balance names of it, and what it does not.

The motor here is integrated in this file, with a friction that sticks, a controller of its own and a host that polls at
uneven times; nothing of the plant is used.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from servo_daemon.diagnosis.inverse.inverse import found_by_balance
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.diagnosis.trial.trial import first_trial
from servo_daemon.diagnosis.verdict.result import Finding
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.samples import F64, SampleBlock, make_block

pytestmark = pytest.mark.slow

#: Over K: A·s²/rad, A·s/rad, A.
INERTIA, VISCOUS, DRY = 2e-3, 0.05, 0.1
TURN_RAD_S, SECONDS, COUNTS = 0.63, 10.0, 8192
#: Harmonic of the turn → amplitude over K, A, and phase.
COGGING = {7: (0.8, -0.65), 14: (0.2, 2.4), 28: (0.2, -0.5)}


def cogging(theta: float, _time: float) -> float:
    return sum(a * np.sin(n * theta + phase) for n, (a, phase) in COGGING.items())


def nothing(_theta: float, _time: float) -> float:
    return 0.0


def dropouts(_theta: float, time: float) -> float:
    """A load that comes and goes, at no fixed times."""
    return 0.6 * float(np.sin(3.1 * time) + np.sin(2.3 * time**1.5) > 0.7)


def captured(load: Callable[[float, float], float], seed: int = 1) -> SampleBlock:
    """Position loop at 4 kHz, semi-implicit; current and encoder polled every 2.3 ms, give or take."""
    h, kp, kd, ki = 2.5e-4, 60.0, 0.5, 300.0
    theta = omega = sum_ = 0.0
    n = round(SECONDS / h)
    angle, current = np.empty(n), np.empty(n)
    for k in range(n):
        error = TURN_RAD_S * k * h - theta
        sum_ += error * h
        i = kp * error + kd * (TURN_RAD_S - omega) + ki * sum_
        angle[k], current[k] = theta, i
        drive = i - load(theta, k * h) - VISCOUS * omega
        free = omega + h * drive / INERTIA
        stop = h * DRY / INERTIA  # what dry friction can take of the speed in a step
        omega = 0.0 if abs(free) <= stop else free - np.sign(free) * stop
        theta += h * omega
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(1.7e-3, 2.9e-3, size=round(0.98 * SECONDS / 2.3e-3)))
    time = time[time < SECONDS - h]
    at = (time / h).astype(int)
    step = 2 * np.pi / COUNTS
    noisy: F64 = current[at] + rng.normal(0.0, 5e-3, len(at))
    return make_block(time, current_A=noisy, position_rad=np.round(angle[at] / step) * step)


def found(block: SampleBlock, fixed: dict[str, float] | None = None) -> Finding | None:
    recordings = (Recording("slow", block),)
    data = Data.of(recordings, fixed or {}, (), segment_length_s(recordings))
    base = first_trial(data, (), {})
    options = FitOptions(fixed=fixed or {}, noise_model="none", thorough=False, segment_s=data.split.segment_s)
    return found_by_balance(data, fit_output_error(recordings, (), options), base, {})


def test_cogging_of_a_rotor_that_stands_nowhere_by_itself() -> None:
    result = found(captured(cogging))
    assert result is not None
    values = result.extended.parameters
    orders = {}
    for effect in (e.name for e in result.effects):
        assert effect.startswith("cogging_torque")
        ending = effect.removeprefix("cogging_torque")
        n = values[f"n_cog{ending}"].value
        assert n is not None
        orders[round(n)] = ending
    assert set(orders) == set(COGGING)
    ratio = {c.expression: c for c in result.extended.combinations}
    for n, (size, phase) in COGGING.items():
        amplitude, angle = ratio[f"Tcog{orders[n]}/K"], values[f"phi_cog{orders[n]}"]
        assert values[f"Tcog{orders[n]}"].value is None  # a current tells torques over K only
        assert abs(amplitude.value - size) < max(3 * amplitude.std, 0.05 * size)
        assert angle.value is not None and angle.std is not None
        assert abs(angle.value - phase) < max(3 * angle.std, 0.05)
    assert result.error_removed > 0.9
    assert result.extended_score.rmse["current_A"] < 0.3 * result.baseline_score.rmse["current_A"]
    # the dry friction of a motion that never reverses is an offset
    assert ratio["TL/K"].value == pytest.approx(DRY, abs=0.04)


def test_with_K_given_torques_have_values() -> None:
    result = found(captured(cogging), {"K": 0.0306})
    assert result is not None
    largest = result.extended.parameters["Tcog"]
    assert largest.status == "estimated" and largest.value is not None
    assert largest.value == pytest.approx(0.8 * 0.0306, rel=0.05)
    assert not result.extended.combinations


@pytest.mark.parametrize("load", [nothing, dropouts])
def test_nothing_is_named_that_is_not_there(load: Callable[[float, float], float]) -> None:
    assert found(captured(load)) is None
