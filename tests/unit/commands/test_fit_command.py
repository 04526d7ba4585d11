"""`servo-daemon fit` as a user calls it: documents, reports, and answers to captures that are no good."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servo_daemon.captures import read_capture, write_capture
from servo_daemon.captures.columns.plausible import plausibility_notes
from servo_daemon.identification.output_error.precision.input_error import USUAL_S
from servo_daemon.simulate import PAPER_MOTOR
from tests.command_line import Result, run_command

Run = Callable[..., Result]

KEYS = {"parameters", "null_directions", "iterations", "residual", "validation", "seconds"}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """10 s of the simulated paper's motor."""
    path = tmp_path_factory.mktemp("fit") / "motor.csv"
    assert run_command("simulate", "--out", path, "--seconds", "6", "--seed", "4").code == 0
    return path


def rewritten(source: Path, target: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A capture with its columns changed."""
    capture = read_capture(source)
    columns = {"time_s": capture.time_s.copy(), **{n: getattr(capture, n).copy() for n in capture.channels}}
    change(columns)
    names = list(columns)
    table = np.column_stack([columns[n] for n in names])
    np.savetxt(target, table, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    return target


def test_the_document_is_the_contracts(capture: Path) -> None:
    document = run_command("fit", capture, "--json").document
    assert document.keys() >= KEYS
    assert list(document["parameters"]) == ["R", "L", "K", "J", "B"]
    truth = read_capture(capture)
    for name, p in document["parameters"].items():
        assert p.keys() >= {"value", "std", "unit", "at_bound"}
        assert abs(p["value"] - float(truth.metadata[f"truth_{name}"])) < 5 * p["std"]
        assert p["at_bound"] is False
    rows = document["iterations"]
    assert [r["iteration"] for r in rows] == list(range(len(rows)))
    assert all(b["function_count"] > a["function_count"] for a, b in pairwise(rows))
    assert all(b["cost"] <= a["cost"] * (1 + 1e-9) for a, b in pairwise(rows))
    assert set(document["residual"]["rmse"]) == {"current_A", "position_rad"}
    assert isinstance(document["residual"]["white"], bool)


def test_the_text_names_every_parameter(capture: Path) -> None:
    result = run_command("fit", capture)
    assert result.code == 0
    assert all(f" {name} = " in result.out for name in ("R", "L", "K", "J", "B"))
    assert "null" not in result.out
    assert "nan" not in result.out.lower()


def test_fixed_values_are_held(capture: Path) -> None:
    document = run_command("fit", capture, "--fix", "R=0.5,K=0.3", "--json").document
    assert document["parameters"]["R"] == {
        "value": pytest.approx(0.5),
        "std": None,
        "unit": "Ω",
        "at_bound": False,
        "status": "fixed",
    }
    assert document["parameters"]["J"]["std"] > 0


def test_effects_and_validation(capture: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.csv"
    assert (
        run_command(
            "simulate", "--out", other, "--seconds", "6", "--seed", "9", "--effect", "coulomb_friction:Tc=0.1"
        ).code
        == 0
    )
    document = run_command(
        "fit", other, "--effect", "coulomb_friction", "--validate", other, capture, "--adapt", "0.3", "--json"
    ).document
    assert document["parameters"]["Tc"]["value"] == pytest.approx(0.1, rel=0.05)
    assert [Path(v["capture"]).name for v in document["validation"]] == ["other.csv", "motor.csv"]
    same, without = document["validation"]
    for v in (same, without):
        for kind in ("baseline", "extended", "adapted"):
            assert (
                v[kind]["rmse"].keys() == v[kind]["rmse_1s"].keys() == {"current_A", "velocity_rad_s", "position_rad"}
            )
    assert same["extended"]["rmse"]["velocity_rad_s"] < 0.5 * same["baseline"]["rmse"]["velocity_rad_s"]
    # The other motor has no dry friction: what settles sees it.
    assert without["adapted"]["settled"]["Tc"] < 0.03
    assert without["adapted"]["rmse"]["velocity_rad_s"] < without["extended"]["rmse"]["velocity_rad_s"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "at"),
    [
        ("resistance_step:dR=0.1,t_R=2.2", "t_R"),
        ("load_torque_step:dTL=0.5,t_TL=4.7", "t_TL"),
        ("periodic_disturbance:Tper=0.3,f_per=7", "f_per"),
    ],
)
def test_instants_and_frequencies_are_searched_for(tmp_path: Path, effect: str, at: str) -> None:
    path, (name, _, values) = tmp_path / "step.csv", effect.partition(":")
    assert run_command("simulate", "--out", path, "--seconds", "6", "--seed", "2", "--effect", effect).code == 0
    document = run_command("fit", path, "--effect", name, "--json").document
    for key, true in (pair.split("=") for pair in values.split(",")):
        assert document["parameters"][key]["value"] == pytest.approx(float(true), rel=0.01), key
    assert document["parameters"][at]["std"] < 1e-3


@pytest.mark.slow
def test_what_switches_between_samples_is_known_no_better_than_a_simulation_is_exact(tmp_path: Path) -> None:
    path = tmp_path / "brushes.csv"
    words = ("--seconds", "20", "--seed", "11", "--effect", "brush_voltage_drop:Vb=1.0")
    assert run_command("simulate", "--out", path, *words).code == 0
    found = run_command("fit", path, "--effect", "brush_voltage_drop", "--json").document["parameters"]
    truth = {**PAPER_MOTOR, "Vb": 1.0}
    for name, p in found.items():
        assert abs(p["value"] - truth[name]) < 2 * p["std"], name
        assert p["std"] < 2e-3 * p["value"], name


def test_a_current_that_the_fit_leaves_open_is_not_scored(capture: Path, tmp_path: Path) -> None:
    bare = rewritten(capture, tmp_path / "bare.csv", lambda c: c.pop("current_A"))
    for fixed, channels in (("R=0.4937", []), ("R=0.4937,K=0.30628", ["current_A"])):
        (v,) = run_command("fit", bare, "--fix", fixed, "--validate", capture, "--json").document["validation"]
        assert list(v["baseline"]["rmse"]) == [*channels, "velocity_rad_s", "position_rad"]
    assert v["baseline"]["rmse"]["current_A"] < 0.1  # the sensor's noise is 0.06 A


def test_a_capture_without_current_says_what_it_holds(capture: Path, tmp_path: Path) -> None:
    bare = rewritten(capture, tmp_path / "bare.csv", lambda c: c.pop("current_A"))
    result = run_command("fit", bare, "--json")
    assert result.code == 0
    document = result.document
    assert len(document["null_directions"]) == 2
    assert all(p["value"] is None and p["std"] is None for p in document["parameters"].values())
    assert {c["expression"] for c in document["combinations"]} >= {"K/(B R + K²)"}
    text = run_command("fit", bare).out
    assert "do not determine" in text


def test_the_report_is_one_file(capture: Path, tmp_path: Path) -> None:
    result = run_command("fit", capture, "--out", tmp_path / "deep" / "report")
    assert result.code == 0
    html = (tmp_path / "deep" / "report" / "report.html").read_text()
    assert "Parameters" in html
    assert 'src="http' not in html
    assert "NaN" not in html.split("<script")[0]
    document = json.loads((tmp_path / "deep" / "report" / "fit.json").read_text())
    assert document["parameters"]["R"]["value"] > 0


def _milliseconds(c: dict[str, Any]) -> None:
    c["time_s"] *= 1e3


def _milliamperes(c: dict[str, Any]) -> None:
    c["current_A"] *= 1e3


def _millivolts(c: dict[str, Any]) -> None:
    c["voltage_V"] *= 1e3


def _kilovolts(c: dict[str, Any]) -> None:
    c["voltage_V"] /= 1e3


def _small_motor_in_kiloamperes(c: dict[str, Any]) -> None:
    c["current_A"] /= 20.0 * 1e3


def _still(c: dict[str, Any]) -> None:
    for name in ("voltage_V", "current_A", "position_rad"):
        c[name][:] = 0.0


def _not_a_number(c: dict[str, Any]) -> None:
    c["current_A"][17] = np.nan


def test_time_in_milliseconds_is_refused_by_name(capture: Path, tmp_path: Path) -> None:
    bad = rewritten(capture, tmp_path / "ms.csv", _milliseconds)
    result = run_command("fit", bad)
    assert result.code == 2
    assert len(result.err.strip().splitlines()) == 1
    assert "ms.csv, column time_s" in result.err
    assert "milliseconds" in result.err


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (_milliamperes, "milliamperes"),
        (_millivolts, "millivolts"),
        (_kilovolts, "kilovolts"),
        (_small_motor_in_kiloamperes, "kA"),
        (_still, "never changes"),
    ],
)
def test_odd_numbers_are_remarked_upon(capture: Path, tmp_path: Path, change: Any, word: str) -> None:
    odd = rewritten(capture, tmp_path / "odd.csv", change)
    assert any(word in note for note in plausibility_notes(read_capture(odd)))


def test_what_is_odd_is_told_by_the_command(capture: Path, tmp_path: Path) -> None:
    result = run_command("fit", rewritten(capture, tmp_path / "odd.csv", _milliamperes))
    assert result.code == 0
    assert "milliamperes" in result.err


@pytest.mark.parametrize(("volts", "ohms"), [(1.5, 20.0), (24.0, 700.0), (0.15, 5.0), (400.0, 0.4), (12.0, 0.01)])
def test_motors_of_all_sizes_are_nothing_odd(capture: Path, tmp_path: Path, volts: float, ohms: float) -> None:
    """From millimetres to tens of kilowatts: the paper's motor with voltages and currents of another winding."""
    voltage, current = volts / 24.0, volts / ohms * 0.4937 / 24.0

    def scale(c: dict[str, Any]) -> None:
        c["voltage_V"] *= voltage
        c["current_A"] *= current

    scaled = rewritten(capture, tmp_path / "scaled.csv", scale)
    assert plausibility_notes(read_capture(scaled)) == ()


def test_what_a_held_voltage_hides_of_j_is_said_or_in_its_deviation(capture: Path, tmp_path: Path) -> None:
    bare = rewritten(capture, tmp_path / "bare.csv", lambda c: c.pop("voltage_V"))
    without = run_command("fit", bare, "--fix", "K=0.30628", "--json").document
    (note,) = (n for n in without["notes"] if "holds its voltage" in n)
    J = without["parameters"]["J"]
    assert f"{100 * 1e-3 * 0.30628**2 / (2 * J['value']):.2g} % over R" in note
    (ratios,) = (n for n in run_command("fit", bare, "--json").document["notes"] if "holds its voltage" in n)
    assert "0.5 ms over the mechanical time constant R J/K²" in ratios
    given = run_command("fit", bare, "--fix", "K=0.30628,R=0.4937", "--json").document
    assert not any("holds its voltage" in n for n in given["notes"])
    hidden = 1e-3 * 0.30628**2 / (2 * 0.4937)
    usual = J["value"] * 0.5e-3 / USUAL_S
    assert usual < J["std"] < 1.2 * usual
    others = np.sqrt(J["std"] ** 2 - usual**2)
    assert given["parameters"]["J"]["std"] == pytest.approx(np.hypot(others, hidden), rel=0.02)


def test_no_excitation_claims_nothing(capture: Path, tmp_path: Path) -> None:
    still = rewritten(capture, tmp_path / "still.csv", _still)
    for method in ("output-error", "idim"):
        document = run_command("fit", still, "--method", method, "--json").document
        assert all(p["std"] is None for p in document["parameters"].values())


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "empty"),
        ("time_s,voltage_V,current_A,position_rad\n", "no rows"),
        ("time_s,voltage_V\n0,1\n1,1\n", "no usable set of columns"),
    ],
)
def test_bad_files_get_one_line(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(content)
    result = run_command("fit", path)
    assert result.code == 2
    assert words in result.err
    assert len(result.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    "words", [("fit", "few"), ("fit", "capture", "--validate", "few"), ("compare", "few"), ("tune", "few")]
)
def test_three_samples_are_no_capture(capture: Path, tmp_path: Path, words: tuple[str, ...]) -> None:
    few = tmp_path / "few.csv"
    few.write_text("time_s,voltage_V,current_A,position_rad\n0,1,0,0\n0.001,1,0.1,0\n0.002,1,0.2,0.001\n")
    result = run_command(*({"few": few, "capture": capture}.get(w, w) for w in words))
    assert result.code == 2
    assert f"{few}: 3 samples are too few" in result.err
    assert "10 at the least" in result.err


def test_nan_is_placed(capture: Path, tmp_path: Path) -> None:
    result = run_command("fit", rewritten(capture, tmp_path / "nan.csv", _not_a_number))
    assert result.code == 2
    assert "line 19, column current_A" in result.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--fix", "Q=3"), "no parameter 'Q'"),
        (("--fix", "R"), "'R' is not of the form"),
        (("--fix", "R=abc"), "'abc' is not a number"),
        (("--fix", "R=-3"), "is outside"),
        (("--fix", "Tc=0.1"), "the model has no parameter Tc"),
        (("--effect", "magic"), "unknown effect 'magic'"),
        (("--adapt", "1.5"), "--adapt must lie between 0 and 1"),
        (("--segment", "0"), "--segment: must be a number greater than zero"),
        (("--segment", "1e-9"), "motor.csv: a free run needs at least 10 samples"),
    ],
)
def test_wrong_flags_are_named(capture: Path, words: tuple[str, ...], message: str) -> None:
    result = run_command("fit", capture, *words)
    assert result.code == 2
    assert message in result.err


def test_the_config_gives_model_and_nominal_values(capture: Path, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text(
        '[[drive]]\nname = "a"\ndriver = "no such driver"\nmodel = ["coulomb_friction"]\n'
        "[drive.nominal]\nR = 1.0\nL = 1e-3\nK = 0.2\nJ = 0.02\nB = 0.3\nTc = 0.01\n"
    )
    document = run_command("fit", capture, "--config", config, "--json").document
    assert document["model"] == ["coulomb_friction"]
    assert document["start"] == "nominal values"
    assert document["iterations"][0]["parameters"]["R"] == pytest.approx(1.0)


def test_a_known_weight_fixes_the_gravity_torque(capture: Path, tmp_path: Path) -> None:
    source = read_capture(capture)
    path = tmp_path / "arm.csv"
    write_capture(path, source.block(), metadata={"mass_kg": "0.5", "arm_length_m": "0.1"})
    words = ("--effect", "gravity_load", "--fix", "R=0.4937,L=2.2769e-3,K=0.30628", "--json")
    document = run_command("fit", path, *words).document
    assert document["parameters"]["Tg"]["status"] == "fixed"
    assert document["parameters"]["Tg"]["value"] == pytest.approx(0.5 * 9.80665 * 0.1)


def test_rotary_and_linear_do_not_mix(capture: Path, tmp_path: Path) -> None:
    other = tmp_path / "axis.csv"
    t = np.arange(100) * 1e-3
    np.savetxt(other, np.c_[t, np.sin(t), t**2], delimiter=",", header="time_s,force_N,position_m", comments="")
    result = run_command("fit", capture, other)
    assert result.code == 2
    assert "cannot be fitted together" in result.err


def test_a_measurement_counts_once(capture: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.csv"
    copy.write_bytes(capture.read_bytes())
    alone, twice = (run_command("fit", *paths, "--json") for paths in ((capture,), (capture, copy)))
    assert "the same samples as" in twice.err + "".join(twice.document["notes"])
    assert twice.document["parameters"] == alone.document["parameters"]


def test_repeated_fix_adds_up_and_twice_the_same_is_refused(capture: Path) -> None:
    document = run_command("fit", capture, "--fix", "R=0.5", "--fix", "K=0.3", "--json").document
    assert [document["parameters"][n]["status"] for n in ("R", "K")] == ["fixed", "fixed"]
    result = run_command("fit", capture, "--fix", "R=0.5", "--fix", "R=0.6")
    assert result.code == 2
    assert "R is given twice" in result.err


def test_signals_that_not_all_captures_have_are_named(capture: Path, tmp_path: Path) -> None:
    bare = rewritten(capture, tmp_path / "bare.csv", lambda c: c.pop("current_A"))
    result = run_command("fit", capture, bare, "--json")
    assert "current_A is not used" in result.err
    assert any("current_A is not used" in note for note in result.document["notes"])


def _turned_current(c: dict[str, Any]) -> None:
    c["current_A"] *= -1


def _turned_position(c: dict[str, Any]) -> None:
    c["position_rad"] *= -1


@pytest.mark.parametrize("change", [_turned_current, _turned_position])
def test_a_turned_sign_is_suspected(capture: Path, tmp_path: Path, change: Any) -> None:
    document = run_command("fit", rewritten(capture, tmp_path / "turned.csv", change), "--json").document
    assert any("sign" in note and "turned" in note for note in document["notes"])
    assert document["residual"]["white"] is False


def test_far_from_nominal_is_remarked_upon(capture: Path, tmp_path: Path) -> None:
    def degrees(c: dict[str, Any]) -> None:
        c["position_rad"] *= 57.29578

    config = tmp_path / "c.toml"
    config.write_text("[[drive]]\n[drive.nominal]\nR = 0.5\nL = 2.3e-3\nK = 0.3\nJ = 0.0098\nB = 0.5\n")
    path = rewritten(capture, tmp_path / "deg.csv", degrees)
    notes = run_command("fit", path, "--config", config, "--json").document["notes"]
    assert any(note.startswith("K = ") and "another unit" in note for note in notes)


def test_what_is_not_determined_is_held_at_its_nominal_value(capture: Path, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text("[[drive]]\n[drive.nominal]\nR = 100\nL = 5\nK = 20\nJ = 1e-7\nB = 1e-9\n")
    bare = rewritten(capture, tmp_path / "bare.csv", lambda c: c.pop("current_A"))
    document = run_command("fit", bare, "--config", config, "--json").document
    assert {n: p["value"] for n, p in document["parameters"].items()} == {
        "R": 100,
        "L": 5,
        "K": 20,
        "J": 1e-7,
        "B": 1e-9,
    }
    assert all(p["std"] is None for p in document["parameters"].values())
    assert all(c["expression"] not in ("L/R", "K/R") for c in document["combinations"])


def test_an_effect_that_may_as_well_be_nothing_has_no_frequency(capture: Path) -> None:
    p = run_command("fit", capture, "--effect", "periodic_disturbance", "--json").document["parameters"]
    assert p["Tper"]["std"] is None
    assert p["f_per"]["std"] is None


def test_adapt_needs_something_to_adapt_to(capture: Path) -> None:
    result = run_command("fit", capture, "--adapt", "0.3")
    assert result.code == 2
    assert "--validate" in result.err
