"""Spikes are left out of the regressions; a step, a pulse of the input and its answer are not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64
from servo_daemon.tracking.samples.spikes import without_spikes

N = 20


def tick(voltage: F64, current: F64 | None) -> Stretch:
    zeros = np.zeros(N)
    return Stretch(np.arange(N) * 1e-3, np.ones(N, dtype=bool), voltage, current, None, zeros, None)


def left_out(voltage: F64, current: F64 | None, most: float = 1.0) -> list[int]:
    return np.flatnonzero(~without_spikes(tick(voltage, current), voltage, most, most).usable).tolist()


def noise() -> F64:
    return np.random.default_rng(1).uniform(-0.2, 0.2, N)


@pytest.mark.parametrize("at", [0, 1, 9, N - 2, N - 1])
@pytest.mark.parametrize("size", [-30.0, 30.0])
def test_a_spike_of_the_current_wherever_it_is(at: int, size: float) -> None:
    current = noise()
    current[at] += size
    assert left_out(noise(), current) == [at]


def test_a_spike_of_the_voltage_with_and_without_a_current() -> None:
    voltage = noise()
    voltage[7] -= 24.0
    assert left_out(voltage, None) == left_out(voltage, noise()) == [7]


def test_a_step_is_none() -> None:
    step = noise() + np.where(np.arange(N) < 10, 0.0, 12.0)
    assert left_out(noise(), step) == left_out(step, None) == []


@pytest.mark.parametrize("late", [0, 1])
def test_nor_is_the_current_of_a_winding_that_follows_a_pulse(late: int) -> None:
    """The pulse itself cannot be told from a voltage that was misread."""
    voltage, current = noise(), noise()
    voltage[8] += 24.0
    current[9 + late] += 6.0
    assert left_out(voltage, current) == [8]


def test_nothing_is_one_before_there_is_anything_to_compare_with_and_what_was_left_out_stays_out() -> None:
    current = noise()
    current[5] += 30.0
    assert left_out(noise(), current, math.inf) == []
    before = tick(noise(), current)
    before.usable[3] = False
    after = without_spikes(before, before.voltage, 1.0, 1.0)
    assert np.flatnonzero(~after.usable).tolist() == [3, 5]
    assert np.flatnonzero(~before.usable).tolist() == [3]


def test_where_the_current_is_the_input_it_is_judged_once() -> None:
    current = noise()
    current[5] += 30.0
    found = without_spikes(tick(noise(), current), current, 1.0, math.inf)
    assert np.flatnonzero(~found.usable).tolist() == [5]


@pytest.mark.parametrize("n", [0, 1, 2])
def test_of_two_samples_nothing_is_told(n: int) -> None:
    few = Stretch(np.arange(n) * 1e-3, np.ones(n, dtype=bool), np.arange(n) * 9.0, np.arange(n) * 9.0, None, None, None)
    assert without_spikes(few, few.voltage, 0.0, 0.0) is few
