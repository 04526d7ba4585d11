"""Fits of the real captures against what is published of them (README of the data)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.command_line import run_command

FRICTION = ("--effect", "coulomb_friction", "--effect", "constant_load_torque")
ASYMMETRIC = ("--effect", "asymmetric_friction", "--effect", "constant_load_torque")
#: Janot, Gautier & Brunot 2019: value, standard deviation.
EMPS = {"J": (95.109, 0.109), "B": (203.50, 1.15), "Tc": (20.394, 0.101), "TL": (-3.165, 0.044)}


def fitted(*words: str | Path) -> Any:
    return run_command("fit", *words, "--json").document


def test_emps_by_the_published_method(servo_data: Path) -> None:
    capture = servo_data / "emps_train.csv.gz"
    document = fitted(capture, *FRICTION, "--method", "idim", "--validate", capture)
    for name, (value, std) in EMPS.items():
        assert abs(document["parameters"][name]["value"] - value) < 2 * std
    assert document["parameters"]["J"]["unit"] == "kg"
    assert document["residual"]["relative_error"]["force_N"] == pytest.approx(0.0418, abs=0.001)
    (free_run,) = document["validation"]
    assert free_run["extended"]["rmse"]["velocity_m_s"] == pytest.approx(4.4e-3, abs=0.15e-3)
    assert 5e-3 < free_run["extended"]["rmse"]["position_m"] < 7e-3


@pytest.mark.slow
def test_emps_by_output_error_runs_freely_better_than_the_published_values(servo_data: Path) -> None:
    capture = servo_data / "emps_train.csv.gz"
    document = fitted(capture, *FRICTION)
    assert document["residual"]["white"] is False  # the friction differs by direction
    assert document["residual"]["rmse"]["position_m"] < 2.6e-3
    better = fitted(capture, "--effect", "asymmetric_friction", "--validate", capture)
    assert better["residual"]["rmse"]["position_m"] < 0.75 * document["residual"]["rmse"]["position_m"]
    # Published, by inverse dynamics: 166.71 and 240.42, 20.144 and 20.628; J 95.15.
    for name, value in {"B": 166.7, "B_neg": 240.4, "Tc": 20.1, "Tc_neg": 20.6, "J": 95.15}.items():
        assert better["parameters"][name]["value"] == pytest.approx(value, rel=0.05)
    (scores,) = better["validation"]
    assert 1.2e-3 < scores["extended"]["rmse"]["velocity_m_s"] < 1.6e-3


def test_emps_fitted_to_free_runs_of_a_second(servo_data: Path) -> None:
    """By hand the same model was brought to 1.25 mm/s and 0.42 mm."""
    capture = servo_data / "emps_train.csv.gz"
    document = fitted(capture, "--effect", "asymmetric_friction", "--segment", "1", "--validate", capture)
    (scores,) = document["validation"]
    assert 1.0e-3 < scores["extended"]["rmse_1s"]["velocity_m_s"] < 1.3e-3
    assert 0.3e-3 < scores["extended"]["rmse_1s"]["position_m"] < 0.5e-3


def test_emps_with_coulomb_friction_alone_says_that_its_200_kg_are_drift(servo_data: Path) -> None:
    """One free run of 25 s under a friction that differs by direction: the motor that drifts least is none."""
    document = fitted(servo_data / "emps_train.csv.gz", "--effect", "coulomb_friction")
    assert document["parameters"]["J"]["value"] > 150.0
    (note,) = (n for n in document["notes"] if "drift" in n)
    assert "position_m" in note
    assert "J = 99" in note
    assert "kg" in note
    assert "--segment 1" in note


def test_levels_by_direction_and_a_constant_load_are_the_same_thing(servo_data: Path) -> None:
    document = fitted(servo_data / "emps_train.csv.gz", *ASYMMETRIC)
    assert any({"Tc", "Tc_neg", "TL"} <= d["components"].keys() for d in document["null_directions"])
    assert all(document["parameters"][name]["std"] is None for name in ("Tc", "Tc_neg", "TL"))


@pytest.mark.parametrize("capture", ["xl330_sin_time_square_kp100", "xl330_sin_time_square_kp400"])
def test_xl330_with_its_known_load(servo_data: Path, capture: str) -> None:
    """Published fits of the Coulomb model: K 0.323–0.387, R 4.0–4.8 (the wrong model biases both)."""
    effects = ("--effect", "coulomb_friction", "--effect", "gravity_load:phi_g=0")
    path = servo_data / f"{capture}.csv.gz"
    document = fitted(path, *effects, "--fix", "B=1e-6,L=1e-3")
    p = document["parameters"]
    assert p["Tg"]["status"] == "fixed"
    assert p["Tg"]["value"] == pytest.approx(0.49 * 9.80665 * 0.1)
    assert 0.30 < p["K"]["value"] < 0.42
    assert 2.8 < p["R"]["value"] < 4.9
    assert abs(p["phi_g"]["value"]) < 0.05
    without = fitted(path, *effects)
    assert without["null_directions"]  # with free viscous friction K²/R and B are not identifiable separately


def test_unal_has_the_published_gain_and_dead_zone(servo_data: Path) -> None:
    """Published: 159.9 (deg/s)/V above a dead zone of 0.2 V."""
    document = fitted(servo_data / "unal_prbs.csv.gz", "--effect", "coulomb_friction")
    assert all(p["value"] is None for p in document["parameters"].values())
    found = {c["expression"]: c["value"] for c in document["combinations"]}
    assert found["K/(B R + K²)"] * 57.2958 == pytest.approx(159.9, rel=0.02)
    assert found["Tc R/K"] == pytest.approx(0.2, abs=0.04)


def test_odrive_holds_ratios_only(servo_data: Path) -> None:
    document = fitted(servo_data / "odrive_slow_nocomp.csv.gz", "--effect", "coulomb_friction")
    assert document["input"] == "current"
    assert any(d["exact"] and {"K", "J", "B"} <= d["components"].keys() for d in document["null_directions"])
    assert document["parameters"]["K"]["value"] is None
