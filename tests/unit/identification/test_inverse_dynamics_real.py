"""EMPS: what Janot, Gautier & Brunot published for it, to every printed digit, and the free run of both models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture
from servo_daemon.identification.inverse_dynamics.filter import Filter, FilterChoice
from servo_daemon.identification.inverse_dynamics.fit import identify_inverse_dynamics
from servo_daemon.identification.paper.free_run import free_run
from servo_daemon.plant.build import build_plant

SYMMETRIC, ASYMMETRIC = ("coulomb_friction", "constant_load_torque"), ("asymmetric_friction",)
#: As published, to all printed digits.
PUBLISHED_EMPS = FilterChoice(dynamics_Hz=20.0, difference_order=2, trim_samples=(49, 0))
#: Value and published 1 σ, N, m, s.
PUBLISHED = {"J": (95.109, 0.109), "B": (203.50, 1.15), "Tc": (20.394, 0.101), "TL": (-3.165, 0.044)}
BY_DIRECTION = {"J": 95.154, "B": 166.71, "B_neg": 240.42, "Tc": 20.144, "Tc_neg": 20.628}


@pytest.fixture(scope="module")
def emps(servo_data: Path) -> Capture:
    return read_capture(servo_data / "emps_train.csv.gz")


def test_published_values_and_deviations(emps: Capture) -> None:
    found = identify_inverse_dynamics([emps.block()], SYMMETRIC, choice=PUBLISHED_EMPS, axis="linear")
    for name, (value, std) in PUBLISHED.items():
        e = found.parameters[name]
        assert e.value == pytest.approx(value, abs=0.02 * std), name
        assert e.std_white == pytest.approx(std, rel=0.01), name
        assert e.std > 2 * std  # the residual is far from white: the published deviations promise too much
    assert 100 * found.residuals["shaft"].relative_error == pytest.approx(4.083, abs=0.001)
    assert found.parameters["J"].unit == "kg" and found.parameters["B"].unit == "N·s/m"


def test_published_asymmetric_friction(emps: Capture) -> None:
    found = identify_inverse_dynamics([emps.block()], ASYMMETRIC, choice=PUBLISHED_EMPS, axis="linear")
    for name, value in BY_DIRECTION.items():
        assert found.parameters[name].value == pytest.approx(value, rel=5e-5), name
    assert 100 * found.residuals["shaft"].relative_error == pytest.approx(3.112, abs=0.001)


def test_frequencies_chosen_from_the_data(emps: Capture) -> None:
    """Nothing told: within one published standard deviation all the same."""
    found = identify_inverse_dynamics([emps.block()], SYMMETRIC, axis="linear")
    assert 15 < found.filters["shaft"].dynamics_Hz < 35  # the authors chose 20 Hz
    for name, (value, std) in PUBLISHED.items():
        assert found.parameters[name].value == pytest.approx(value, abs=std), name


@pytest.mark.parametrize(
    ("effects", "values", "velocity_mm_s", "position_mm"),
    [
        (SYMMETRIC, {n: v for n, (v, _) in PUBLISHED.items()}, (4.2, 4.6), (5.0, 7.0)),
        (ASYMMETRIC, BY_DIRECTION, (1.5, 1.75), (2.6, 3.5)),
    ],
    ids=["symmetric", "asymmetric"],
)
def test_free_run_of_the_published_models(
    emps: Capture,
    effects: tuple[str, ...],
    values: Mapping[str, float],
    velocity_mm_s: tuple[float, float],
    position_mm: tuple[float, float],
) -> None:
    f = Filter(1000.0, 20.0, 100.0, 10, 8, (49, 49))
    position = f.smooth(emps.position_rad)
    velocity = f.derivative(position)
    start = {"velocity_rad_s": velocity[0], "position_rad": position[0]}
    states = free_run(build_plant(effects, "torque"), values, emps.time_s, emps.torque_Nm, start)
    rmse = 1e3 * np.sqrt(np.mean((states - np.column_stack([velocity, emps.position_rad])) ** 2, axis=0))
    assert velocity_mm_s[0] < rmse[0] < velocity_mm_s[1]
    assert position_mm[0] < rmse[1] < position_mm[1]
