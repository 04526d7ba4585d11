"""Dry friction that turns round between two slow samples: what a free run and a filter's step make of it."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error.problem.rollout import free_run, simulate
from servo_daemon.kalman.gaussian import coordinates_of
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.samples import F64
from tests.few_samples import run_uncompiled

CHANNELS = ("current_A", "velocity_rad_s", "position_rad")
#: An RE 40 with a tenth of its rated torque in the bearings.
MOTOR = {"R": 1.13, "L": 0.33e-3, "K": 60.3e-3, "J": 4.0e-5, "B": 3.0e-5, "Tc": 0.018}
PLANT = build_plant(("coulomb_friction",))
Q = coordinates_of(PLANT.parameters, MOTOR)


def _rows(period_s: float, n: int = 60) -> F64:
    voltage = np.random.default_rng(11).normal(0.0, 2.0, n)
    return np.column_stack([np.arange(n) * period_s, np.full(n, period_s), voltage])


def _finely(rows: F64, parts: int) -> F64:
    """Speed at the samples from steps of so many parts, shape (n,)."""
    cut = np.repeat(rows, parts, axis=0)
    cut[:, 1] /= parts
    cut[:, 0] = np.cumsum(cut[:, 1]) - cut[:, 1]
    return free_run(PLANT, CHANNELS, Q, np.zeros(3), cut)[0][::parts, 1]


@pytest.mark.parametrize("period_s", [0.05, 0.02, 0.01])
def test_long_samples_are_as_exact_as_short_ones(monkeypatch: pytest.MonkeyPatch, period_s: float) -> None:
    run_uncompiled(monkeypatch)
    rows = _rows(period_s)
    exact = _finely(rows, 256)

    def error(plant: PlantModel) -> float:
        return float(np.sqrt(np.mean((free_run(plant, CHANNELS, Q, np.zeros(3), rows)[0][:, 1] - exact) ** 2)))

    once = error(PLANT)
    assert error(PLANT.for_runs_of(period_s)) < 0.1 * once
    assert error(PLANT.for_filter_of(period_s)) < 0.3 * once


def test_short_samples_and_smooth_motors_are_as_they_were() -> None:
    smooth = build_plant(("constant_load_torque",))
    for plant in (PLANT.for_runs_of(0.005), PLANT.for_filter_of(0.005)):
        assert plant is PLANT
    for plant in (smooth.for_runs_of(0.05), smooth.for_filter_of(0.05)):
        assert plant is smooth
    assert PLANT.for_runs_of(0.05).with_effects(("stribeck_friction",)).pieces == PLANT.for_runs_of(0.05).pieces


def test_derivatives_are_those_of_the_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    run_uncompiled(monkeypatch)
    plant, rows, x0 = PLANT.for_runs_of(0.02), _rows(0.02), np.zeros(3)
    run, k = simulate(plant, CHANNELS, Q, x0, rows), PLANT.parameter_names.index("J")
    there, back = Q.copy(), Q.copy()
    there[k], back[k] = Q[k] + 1e-7, Q[k] - 1e-7
    by_difference = (free_run(plant, CHANNELS, q, x0, rows)[0] for q in (there, back))
    slope = np.subtract(*by_difference) / 2e-7
    np.testing.assert_allclose(run.by_parameter[..., k], slope, atol=1e-4 * float(np.max(np.abs(slope))))
