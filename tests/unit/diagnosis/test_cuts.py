"""Free runs of several lengths: what is averaged, and what is none of it."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servo_daemon.diagnosis.trial import cuts

#: A logarithm and a phase.
HERE = (-4.0, 0.4)


def fit_of(unknowns: tuple[float, ...], rms: float) -> Any:
    problem = SimpleNamespace(n_shared=2, free=("Tcog", "phi_cog"), is_phase=np.array([False, True]))
    point = SimpleNamespace(unknowns=np.array(unknowns), sse=np.array([rms**2]))
    return SimpleNamespace(problem=problem, values={}, solution=SimpleNamespace(point=point))


def estimates(monkeypatch: pytest.MonkeyPatch, found: list[tuple[tuple[float, ...], float]]) -> list[np.ndarray]:
    """Of these fits, from the shortest runs to those of four times their length."""
    made = iter([fit_of(*one) for one in found])
    monkeypatch.setattr(cuts, "fit_runs", lambda *_: next(made))
    data: Any = SimpleNamespace(split=SimpleNamespace(segment_s=0.4))
    trial: Any = SimpleNamespace(values={})
    return cuts._estimates(data, trial, fit_of(HERE, 1.0))


def test_a_phase_is_that_of_the_same_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    turned = [((-4.0, 0.4 + 0.01 * k + 2.0 * math.pi * (k % 3 - 1)), 1.0) for k in range(5)]
    np.testing.assert_allclose(estimates(monkeypatch, turned), [(-4.0, 0.4 + 0.01 * k) for k in range(5)])


def test_runs_in_which_the_motor_has_run_away_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lengths grow by √2, and what a constant torque adds up to twofold: cogging on samples of 200 Hz grew faster."""
    found = [(HERE, 1.0), ((-3.76, 0.56), 19.5), ((-3.9, 0.42), 1.4), ((-3.85, 2.8), 83.0), ((-3.86, 0.8), 15.0)]
    assert [x[1] for x in estimates(monkeypatch, found)] == pytest.approx([0.4, 0.42, 0.8])
