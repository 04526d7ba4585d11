"""`servo-daemon excite`: the file, the document, and one line for what cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import run_command

_CONFIG = """[[drive]]
name = "bench"
driver = "serial"
model = [{model}]
[drive.nominal]
R = 0.4937
L = 2.2769e-3
K = 0.30628
J = 0.009751
J_m = 0.0081
B = 0.51141
[drive.load]
counts_per_rev = 8192
[drive.limits]
{limits}
"""
_SHORT = ("--seconds", "3", "--rate", "300")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return _written(tmp_path, "voltage_V = 24.0\ncurrent_A = 20.0\nR_max = '+30 %'")


def _written(folder: Path, limits: str, model: str = "") -> Path:
    path = folder / "servo.toml"
    path.write_text(_CONFIG.format(limits=limits, model=model), encoding="utf-8")
    return path


def _read(path: Path) -> tuple[dict[str, list[str]], list[str], np.ndarray]:
    """Metadata (a key may repeat), columns, values."""
    lines = path.read_text(encoding="utf-8").splitlines()
    head = [line[2:].split(": ", 1) for line in lines if line.startswith("# ")]
    metadata: dict[str, list[str]] = {}
    for key, value in head:
        metadata.setdefault(key, []).append(value)
    rows = [line for line in lines if not line.startswith("#")]
    return metadata, rows[0].split(","), np.array([[float(x) for x in row.split(",")] for row in rows[1:]])


def test_the_plan_is_a_csv_that_says_what_it_is(config: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan.csv"
    document = run_command("excite", "--config", config, "--out", out, *_SHORT, "--for", "L", "--json").document
    metadata, columns, values = _read(out)
    assert columns == ["time_s", "voltage_V"] and values.shape == (900, 2)
    assert np.diff(values[:, 0]) == pytest.approx(1 / 300, rel=1e-5)
    assert np.abs(values[:, 1]).max() == pytest.approx(document["peaks"]["nominal"]["voltage_V"], rel=1e-4)
    assert np.abs(values[:, 1]).max() <= 24.0 == document["limits"]["voltage_V"]
    assert metadata["drive"] == ["bench"] and metadata["limit_current_A"] == ["20"]
    assert len(metadata["block"]) == len(document["blocks"]) and metadata["nominal_R"] == ["0.4937"]
    assert document["limits"]["travel_rad"] is None and "travel_rad" in " ".join(document["notes"])
    wanted = {name: p["wanted"] for name, p in document["parameters"].items()}
    assert wanted == {"R": False, "L": True, "K": False, "J": False, "B": False}
    assert document["parameters"]["L"]["ratio"] >= 1.0 and document["separation"] == []


def test_a_reader_gets_a_table(config: Path, tmp_path: Path) -> None:
    result = run_command("excite", "--config", config, "--out", tmp_path / "p.csv.gz", *_SHORT)
    assert result.code == 0 and (tmp_path / "p.csv.gz").stat().st_size > 1000
    for word in ("multisine", "voltage", "20 A", "RMS current", "L = 0.0022769 ±"):
        assert word in result.out
    assert "no velocity_rad_s in [drive.limits]" in result.err


def test_causes_are_told_apart(config: Path, tmp_path: Path) -> None:
    words = ("excite", "--config", config, "--out", tmp_path / "p.csv", *_SHORT, "--between")
    document = run_command(*words, "coulomb_friction", "stribeck_friction", "--json").document
    one, other = document["separation"]
    assert one["truth"] == other["fitted"] == ["coulomb_friction"]
    assert other["truth"] == one["fitted"] == ["stribeck_friction"]
    assert other["error_over_noise"] > max(1.05, other["multisine_error_over_noise"])
    assert document["parameters"] == {}


def test_what_no_motion_tells_apart_is_said(config: Path, tmp_path: Path) -> None:
    """A gain of the current sensor is the same as other R, L, J and B: known to the contract, found by the plan."""
    words = ("excite", "--config", config, "--out", tmp_path / "p.csv", *_SHORT, "--between", "current_sensor_gain")
    result = run_command(*words, "none")
    assert result.code == 0 and "no motion of the family tells these apart" in result.out


def test_a_candidate_takes_the_place_of_another_dry_friction(tmp_path: Path) -> None:
    config = _written(tmp_path, "voltage_V = 24.0", '"coulomb_friction", "constant_load_torque"')
    words = ("excite", "--config", config, "--out", tmp_path / "p.csv", *_SHORT, "--json", "--between")
    document = run_command(*words, "asymmetric_friction", "none").document
    assert document["separation"][0]["truth"] == ["constant_load_torque", "asymmetric_friction"]
    assert document["separation"][0]["fitted"] == ["coulomb_friction", "constant_load_torque"]


def _diagnosis(path: Path, equivalent: list[list[str]]) -> Path:
    parameters = {
        name: {"value": value, "std": 0.0, "unit": ""}
        for name, value in {"R": 0.6, "L": 2e-3, "K": 0.3, "J": 0.01, "B": 0.5, "Tc": 0.2, "t_R": None}.items()
    }
    effects = [{"name": "coulomb_friction", "parameters": {}, "equivalent": equivalent}]
    document = {"schema": 1, "verdict": "found", "effects": effects, "baseline": {"parameters": parameters}}
    path.write_text(json.dumps(document | {"extended": {"parameters": parameters}}), encoding="utf-8")
    return path


def test_a_diagnosis_says_what_is_open(config: Path, tmp_path: Path) -> None:
    diagnosis = _diagnosis(tmp_path / "diagnosis.json", [["load_dependent_friction"]])
    words = ("excite", "--config", config, "--out", tmp_path / "p.csv", *_SHORT, "--json", "--diagnosis", diagnosis)
    document = run_command(*words).document
    assert {tuple(s["truth"]) for s in document["separation"]} == {("coulomb_friction",), ("load_dependent_friction",)}
    assert document["nominal"]["R"] == 0.6 and document["nominal"]["Tc"] == 0.2
    assert any("fit its data equally well" in note for note in document["notes"])


def test_a_diagnosis_without_ties_asks_for_its_parameters(config: Path, tmp_path: Path) -> None:
    diagnosis = _diagnosis(tmp_path / "diagnosis.json", [])
    words = ("excite", "--config", config, "--out", tmp_path / "p.csv", *_SHORT, "--json", "--diagnosis", diagnosis)
    document = run_command(*words).document
    assert "Tc" in document["parameters"] and document["separation"] == []


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--seconds", "0"), "--seconds"),
        (("--seconds", "nan"), "--seconds"),
        (("--rate", "-5"), "--rate"),
        (("--seconds", "1000"), "at most 120 s"),
        (("--seconds", "0.1"), "at least"),
        (("--seed", "-1"), "--seed"),
        (("--for", "Tc"), "no parameter Tc to determine: free in this model are R, L, K, J, B"),
        (("--for", "R", "--fix", "R=0.5"), "no parameter R"),
        (("--between", "coulomb_friction"), "two at least"),
        (("--between", "coulomb_friction", "coulomb_friction"), "different"),
        (("--between", "rust", "none"), "unknown effect 'rust'"),
        (("--for", "L", "--between", "none", "drive_lag"), "not allowed with"),
        (("--rms-current", "0"), "--rms-current"),
        (("--current-noise", "-1"), "--current-noise"),
        (("--diagnosis", "none.json"), "none.json: cannot be read"),
        (("--fix", "R=0"), "outside"),
    ],
)
def test_bad_input_is_one_line(config: Path, tmp_path: Path, words: tuple[str, ...], says: str) -> None:
    result = run_command("excite", "--config", config, "--out", tmp_path / "p.csv", *words)
    assert result.code == 2 and says in result.err and "Traceback" not in result.err
    assert not (tmp_path / "p.csv").exists()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[]", "not a diagnosis.json"),
        ("{}", "schema None, this"),
        ('{"schema": 1}', "it has no 'effects'"),
        ('{"schema": 2}', "schema 2, this version reads 1"),
        ("x", "not a JSON document"),
    ],
)
def test_a_document_that_is_no_diagnosis_is_named(config: Path, tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "d.json").write_text(text, encoding="utf-8")
    result = run_command("excite", "--config", config, "--out", tmp_path / "p.csv", "--diagnosis", tmp_path / "d.json")
    assert result.code == 2 and says in result.err and "d.json" in result.err


def test_without_limits_or_motor_there_is_no_plan(tmp_path: Path) -> None:
    result = run_command("excite", "--config", _written(tmp_path, ""), "--out", tmp_path / "p.csv")
    assert result.code == 2 and "[drive.limits]" in result.err
    (tmp_path / "bare.toml").write_text("[[drive]]\n[drive.limits]\nvoltage_V = 24.0\n", encoding="utf-8")
    result = run_command("excite", "--config", tmp_path / "bare.toml", "--out", tmp_path / "p.csv")
    assert result.code == 2 and "R, L, K, J, B" in result.err


def test_the_name_and_the_place_are_checked(config: Path, tmp_path: Path) -> None:
    result = run_command("excite", "--config", config, "--out", tmp_path / "p.txt", *_SHORT)
    assert result.code == 2 and ".csv" in result.err
    result = run_command("excite", "--config", config, "--out", tmp_path / "none" / "p.csv", *_SHORT)
    assert result.code == 2 and "cannot be written" in result.err
