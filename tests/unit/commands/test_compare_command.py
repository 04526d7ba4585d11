"""`servo-daemon compare`: the paper's numbers to the digit, and three methods on one capture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servo_daemon.captures import read_capture, write_capture
from servo_daemon.identification.paper.position_experiment import position_test, product_for
from tests.command_line import run_command

PAPER_1 = {"R": 1.5, "L": 1.815e-3, "K": 4.25e-3, "J": 12.267e-3, "B": 0.66665}
PAPER_2 = {"R": 0.4937, "L": 2.2769e-3, "K": 0.30628, "J": 0.009751, "B": 0.51141}


@pytest.fixture(scope="module")
def paper() -> Any:
    """The document of `compare --paper`."""
    return run_command("compare", "--paper", "--json").document


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("compare") / "motor.csv"
    assert run_command("simulate", "--out", path, "--seconds", "8", "--seed", "2").code == 0
    return path


@pytest.fixture(scope="module")
def compared(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The document of `compare` with the R of a datasheet that is nearly right; method 3 is trained on the spot."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("servo_daemon.learning.model.cache.cache_directory", lambda: tmp_path_factory.mktemp("cache"))
        return run_command("compare", capture, "--assumed-R", "0.5", "--motors", "250", "--json").document


def test_method_1_of_the_paper_to_the_digit(paper: Any) -> None:
    found = paper["method1_paper"]
    assert f"{found['J'] * 1e3:.2f}" == "12.27"
    assert f"{found['L'] * 1e3:.2f}" == "1.81" or f"{found['L'] * 1e3:.2f}" == "1.82"
    assert f"{found['D']:.2f}" == "0.67"
    assert found["K"] == 4.25e-3
    digits = paper["method1_digits"]
    assert all(c["agreeing"] == c["digits"] for c in digits.values())
    assert [n for n, c in digits.items() if c["input"]] == ["R", "K"]


def test_one_gain_is_chosen_and_the_rest_follows(paper: Any) -> None:
    test = paper["paper_position_test"]
    assert test["k_io_k_s_V_rad"] == pytest.approx(108, rel=0.01)
    assert test["methods"]["method1"]["final_deg"] == pytest.approx(45.0, abs=1e-6)
    assert test["methods"]["method2"]["final_deg"] == pytest.approx(50.0, abs=0.01)
    assert test["methods"]["method2"]["overshoot"] > 0.3  # which the paper does not tell


def test_method_2_from_the_papers_start_beats_its_table(paper: Any) -> None:
    table = paper["table1"]
    fall = table["paper"][0]["cost"] / table["paper"][-1]["cost"]
    rows = table["angle_alone"]["iterations"]
    assert rows[0]["parameters"] == pytest.approx(table["start"], rel=1e-9)
    fourth = rows[min(4, len(rows) - 1)]
    assert rows[0]["cost"] / fourth["cost"] > fall
    assert fourth["function_count"] <= table["paper"][-1]["function_count"]
    assert len(table["angle_alone"]["null_directions"]) == 2
    assert all(p["std"] is None for p in table["angle_alone"]["parameters"].values())


def test_from_current_and_angle_all_five_come_out(paper: Any) -> None:
    run = paper["table1"]["current_and_angle"]
    assert run["start"] == "nominal values"
    assert run["null_directions"] == []
    assert all(abs(e) < 3 for e in run["errors_in_std"].values())
    for name, floor in run["noise_floor"].items():
        assert run["residual"]["rmse"][name] == pytest.approx(floor, rel=0.01)


def test_the_methods_on_one_capture(compared: Any) -> None:
    methods = compared["methods"]
    assert list(methods) == ["method1_paper", "method1", "method2", "method3"]
    worst = {key: max(abs(e) for e in m["errors"].values()) for key, m in methods.items() if m["available"]}
    assert worst["method2"] < 0.01 < worst["method1"] < worst["method1_paper"]
    assert set(methods["method3"]["errors"]) == {"R", "L", "K", "J", "B"}
    assert worst["method3"] < 0.05
    assert "250 simulated motors" in methods["method3"]["notes"][0]
    inside = [
        abs(p["value"] - compared["truth"][n]) < 3 * p["std"] for n, p in methods["method3"]["parameters"].items()
    ]
    assert all(inside)
    assert worst["method1"] < 0.2
    assert methods["method2"]["heldout"]["rmse"]["current_A"] < methods["method1"]["heldout"]["rmse"]["current_A"]
    distance = {key: m["position_test"]["distance_deg"] for key, m in methods.items() if m["available"]}
    assert distance["method2"] < distance["method1"]
    assert compared["position_test"]["reference"] == "truth"
    assert compared["truth"]["R"] == pytest.approx(0.4937)


def test_a_wrong_R_is_told(capture: Path) -> None:
    methods = run_command("compare", capture, "--motors", "0", "--json").document["methods"]
    assert methods["method1"]["available"] is False
    assert "the assumed R is too large" in methods["method1"]["reason"]


def test_without_the_truth_the_reference_is_named(capture: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.csv"
    write_capture(bare, read_capture(capture).block())
    document = run_command("compare", bare, "--assumed-R", "0.5", "--motors", "0", "--json").document
    assert document["truth"] is None
    assert document["position_test"]["reference"] == "method2"
    assert document["methods"]["method2"]["errors"] == {}


def test_without_a_current_the_rows_say_why(capture: Path, tmp_path: Path) -> None:
    source = read_capture(capture)
    table = np.column_stack([source.time_s, source.voltage_V, source.position_rad])
    path = tmp_path / "no_current.csv"
    np.savetxt(path, table, delimiter=",", header="time_s,voltage_V,position_rad", comments="", fmt="%.9g")
    methods = run_command("compare", path, "--json").document["methods"]
    assert "current_A" in methods["method3"]["reason"]
    assert "current_A" in methods["method1"]["reason"]
    notes = methods["method2"]["notes"]
    assert any("not determined" in note for note in notes)
    assert any(note.startswith("K/(B R + K²) = ") for note in notes)  # what is determined is told


def test_a_held_shaft_is_no_wrong_sign(tmp_path: Path) -> None:
    time_s = np.arange(1500) * 1e-3
    volts = np.random.default_rng(4).choice([-1.0, 1.0], 15).repeat(100)
    current = np.zeros(1500)
    for k in range(1499):
        current[k + 1] = volts[k] + (current[k] - volts[k]) * np.exp(-0.5)  # R = 1 Ω, L = 2 mH
    table = np.column_stack([time_s, volts, current, np.zeros(1500)])
    path = tmp_path / "held.csv"
    np.savetxt(path, table, delimiter=",", header="time_s,voltage_V,current_A,position_rad", comments="", fmt="%.9g")
    methods = run_command("compare", path, "--motors", "0", "--json").document["methods"]
    assert all("does not turn" in methods[name]["reason"] for name in ("method1_paper", "method1"))


def test_the_text_and_the_report(capture: Path, tmp_path: Path) -> None:
    result = run_command(
        "compare", capture, "--assumed-R", "0.5", "--motors", "0", "--paper", "--out", tmp_path / "out"
    )
    assert result.code == 0
    assert "12.27e-3" in result.out
    assert "2 output error" in result.out
    html = (tmp_path / "out" / "report.html").read_text()
    assert "Figure 6" in html
    assert json.loads((tmp_path / "out" / "compare.json").read_text())["method1_paper"]


def test_method_3_can_be_left_out(capture: Path) -> None:
    row = run_command("compare", capture, "--assumed-R", "0.5", "--motors", "0", "--json").document["methods"][
        "method3"
    ]
    assert not row["available"]
    assert "--motors 0" in row["reason"]


@pytest.mark.parametrize(
    ("words", "message"), [((), "a CAPTURE is needed"), (("--paper", "--assumed-R", "-1"), "greater than zero")]
)
def test_wrong_use(words: tuple[str, ...], message: str) -> None:
    result = run_command("compare", *words)
    assert result.code == 2
    assert message in result.err


def test_the_position_test_against_its_closed_form() -> None:
    """Slow motor: the loop is of first order, θ(t) = 50° (1 − exp(−k t))."""
    product = 10.0
    rate = product * PAPER_1["K"] / (PAPER_1["B"] * PAPER_1["R"] + PAPER_1["K"] ** 2)
    expected = 50.0 * (1.0 - np.exp(-rate * 5.0))
    assert position_test(PAPER_1, product).final_deg == pytest.approx(expected, rel=0.01)


def test_the_gain_is_found_for_another_angle() -> None:
    product = product_for(PAPER_1, 30.0)
    assert position_test(PAPER_1, product).final_deg == pytest.approx(30.0, abs=1e-6)


def test_an_unstable_loop_is_called_so() -> None:
    assert position_test(PAPER_2, 107.8).stable
    assert not position_test(PAPER_2, 1000.0).stable
