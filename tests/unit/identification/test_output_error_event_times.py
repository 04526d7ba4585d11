"""The likeliest instant of a step, and how well it is known: against a change of a mean whose answer is known."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from servo_daemon.identification.output_error.problem.event_times import profile
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.rollout import INPUT, TIME
from servo_daemon.samples import F64

PERIOD_S, N = 1e-3, 20_000


def problem() -> Problem:
    rows = np.zeros((N, INPUT + 1))
    rows[:, TIME] = np.arange(N) * PERIOD_S
    bounds, segments = (np.array([0.0]), np.array([1e9])), (SimpleNamespace(rows=rows),)
    return cast(Problem, SimpleNamespace(bounds=bounds, segments=segments, sample_period_s=PERIOD_S))


def change(true_s: float, size: F64, seed: int) -> Callable[[float], float]:
    """−2 log p of a signal in unit noise that steps by its size at the true instant, if it steps elsewhere."""
    time_s = np.arange(N) * PERIOD_S
    signal = np.random.default_rng(seed).normal(size=N) + np.where(time_s >= true_s, size, 0.0)
    return lambda at_s: float(np.sum((signal - np.where(time_s >= at_s, size, 0.0)) ** 2))


@pytest.mark.parametrize("begin_s", [3.0, 12.5, 19.0])
def test_the_likeliest_instant_is_found_from_far_away(begin_s: float) -> None:
    """What steps is nothing for stretches of 50 ms (a current that reverses): no derivative leads across them."""
    size = 0.5 * (np.sin(2 * np.pi * 5 * np.arange(N) * PERIOD_S) > -0.5)
    at_s, std_s = profile(problem(), 0, begin_s, change(12.0, size, seed=1))
    assert at_s == pytest.approx(12.0, abs=4 * std_s)
    assert std_s < 0.1


def test_its_standard_deviation_holds_the_errors() -> None:
    """σ = 0.1: about 26/0.1⁴ samples² (Hinkley 1970), half a second, where a Fisher information of one sample's
    derivative would say 10 ms."""
    size = np.full(N, 0.1)
    found = [profile(problem(), 0, 9.0, change(10.0, size, seed)) for seed in range(60)]
    z = np.array([(at_s - 10.0) / std_s for at_s, std_s in found])
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.4)
    assert np.abs(z).max() < 4.0
    errors = [at_s - 10.0 for at_s, _ in found]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.sqrt(26.0) / 0.1**2 * PERIOD_S, rel=0.5)


def test_a_step_seen_in_one_sample_is_known_to_that_sample() -> None:
    at_s, std_s = profile(problem(), 0, 9.0, change(10.0, np.full(N, 20.0), seed=3))
    assert at_s == pytest.approx(10.0, abs=1.01 * PERIOD_S)
    assert PERIOD_S / 4 < std_s < PERIOD_S
