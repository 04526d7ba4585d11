"""Diagnoses of the real captures: what is known to be in them is named, and it gains what was measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.unit.commands import run_command

pytestmark = pytest.mark.slow


def diagnosed(*words: str | Path) -> Any:
    return run_command("diagnose", *words, "--json").document


def names(document: Any) -> list[str]:
    return [effect["name"] for effect in document["effects"]]


def test_emps_friction_by_direction_and_along_the_screw(servo_data: Path) -> None:
    document = diagnosed(servo_data / "emps_train.csv.gz")
    assert names(document) == ["asymmetric_friction", "position_dependent_friction"]
    assert 0.97 < document["gain"]["error_removed"] <= 1.0
    mass = document["extended"]["parameters"]["J"]
    assert mass["unit"] == "kg"
    assert 94.5 < mass["value"] < 95.7  # published: 95.1
    (free_runs,) = document["free_runs"]
    assert 0.9e-3 < free_runs["extended"]["rmse_1s"]["velocity_m_s"] < 1.2e-3
    assert 0.3e-3 < free_runs["extended"]["rmse_1s"]["position_m"] < 0.55e-3


def test_xl330_lifts_a_pendulum(servo_data: Path) -> None:
    document = diagnosed(servo_data / "xl330_sin_time_square_kp100.csv.gz")
    assert "gravity_load" in names(document)
    assert document["gain"]["error_removed"] > 0.9


def test_unal_has_a_dead_zone(servo_data: Path) -> None:
    """0.2 V of it, published. Its speed never reverses: Coulomb friction, a constant load and an offset of the voltage
    are the same there, and that is said."""
    document = diagnosed(servo_data / "unal_prbs.csv.gz")
    (effect,) = document["effects"]
    assert effect["name"] == "coulomb_friction"
    ties = {name for tie in effect["equivalent"] for name in tie}
    assert {"constant_load_torque", "voltage_sensor_offset"} <= ties
    offset = diagnosed(servo_data / "unal_prbs.csv.gz", "--effect", "voltage_sensor_offset")
    assert 0.17 < offset["baseline"]["parameters"]["v0"]["value"] < 0.27
