"""`servo-daemon diagnose` as a user calls it: exit codes, stdout, stderr, files, and captures that are no good."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servo_daemon.captures import read_capture
from servo_daemon.samples import F64
from tests.command_line import run_command
from tests.diagnosed import TC, Run, dry_friction

Columns = dict[str, F64]


@pytest.fixture(scope="module")
def found(once: Callable[[str, Callable[[], Any]], Any], run_folder: Path) -> Run:
    """The whole command on 6 s of the simulated paper's motor with dry friction."""
    return dry_friction(once, run_folder)


@pytest.fixture(scope="module")
def capture(found: Run) -> Path:
    return found.capture


def rewritten(source: Path, target: Path, change: Callable[[Columns], Columns]) -> Path:
    """A capture with its columns changed."""
    c = read_capture(source)
    columns = change({"time_s": c.time_s.copy(), **{n: getattr(c, n).copy() for n in c.channels}})
    table = np.column_stack(list(columns.values()))
    np.savetxt(target, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    return target


def test_the_cause_is_named_with_its_size(found: Run) -> None:
    document = found.document
    assert document["verdict"] == "found"
    assert [e["name"] for e in document["effects"]] == ["coulomb_friction"]
    tc = document["effects"][0]["parameters"]["Tc"]
    assert tc["unit"] == "N·m"
    assert abs(tc["value"] - TC) < 5 * tc["std"] < 0.05 * TC
    low, high = document["gain"]["ci95"]
    assert 0.9 < low <= document["gain"]["error_removed"] <= high < 1.05
    assert document["gain"]["measured_on"] == "unseen"


@pytest.mark.slow
def test_what_there_was_no_time_for_is_told_and_another_try_goes_on(capture: Path, found: Run, tmp_path: Path) -> None:
    words, journal = ("--json", "--journal", tmp_path / "journal.jsonl"), tmp_path / "journal.jsonl"
    assert found.document["unfinished"] is None
    short = run_command("diagnose", capture, *words, "--budget", "0.1").document
    assert short["verdict"] == "unexplained", "what was not tried is no reason to call it explained"
    assert "coulomb_friction" in short["unfinished"]["not_tried"]
    whole = run_command("diagnose", capture, *words).document
    kept = len(journal.read_text().splitlines())
    again = run_command("diagnose", capture, *words).document
    assert whole["unfinished"] is None and kept > 0
    assert len(journal.read_text().splitlines()) == kept, "nothing is fitted twice"
    for document in (whole, again):
        (effect,) = document["effects"]
        (true,) = found.document["effects"]
        assert effect["name"] == true["name"]
        assert effect["parameters"]["Tc"]["value"] == pytest.approx(true["parameters"]["Tc"]["value"], rel=1e-6)


def test_stdout_is_one_document_and_the_files_are_the_same(found: Run) -> None:
    written = json.loads((found.folder / "diagnosis.json").read_text())
    assert written == json.loads(found.result.out)
    assert sorted(p.name for p in found.folder.iterdir()) == ["diagnosis.json", "report.html"]


def test_the_report_is_one_file_without_numbers_that_are_none(found: Run) -> None:
    html = (found.folder / "report.html").read_text()
    assert 'src="http' not in html
    text = html.split("<script")[0]
    assert "NaN" not in text.split("<style>")[0] + text.split("</style>")[1]
    for words in ("Found: coulomb friction", "Missing torque over speed", "Missing voltage over frequency", "Tc ="):
        assert words in html
    assert len(html) < 4e6


def test_validation_scores_all_three(found: Run) -> None:
    (row,) = found.document["validation"]
    assert row["baseline"]["rmse"].keys() == {"current_A", "velocity_rad_s", "position_rad"}
    assert row["extended"]["rmse_1s"]["velocity_rad_s"] < 0.5 * row["baseline"]["rmse_1s"]["velocity_rad_s"]
    assert row["adapted"]["settled"] == {}  # it is the capture that was fitted


def test_progress_is_lines_of_json_that_never_fall(found: Run) -> None:
    lines = [json.loads(line) for line in found.result.err.splitlines() if line.startswith("{")]
    assert [set(line) for line in lines] == [{"progress", "step"}] * len(lines)
    assert len(lines) > 5
    assert all(a["progress"] <= b["progress"] for a, b in pairwise(lines))
    assert (lines[0]["progress"], lines[-1]["progress"]) == (0.0, 1.0)
    assert any("coulomb_friction" in line["step"] for line in lines)


@pytest.mark.slow
def test_with_the_effect_in_the_drives_model_nothing_is_missing(capture: Path, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text(
        '[[drive]]\nname = "other"\n[[drive]]\nname = "a"\ndriver = "no such driver"\nmodel = ["coulomb_friction"]\n'
        "[drive.nominal]\nR = 0.5\nL = 2e-3\nK = 0.3\nJ = 0.01\nB = 0.5\nTc = 0.1\n"
    )
    words = ("--config", config, "--drive", "a")
    result = run_command("diagnose", capture, *words)
    assert result.code == 0
    assert result.out.startswith("Nothing is missing: ")
    assert "the linear motor + coulomb_friction" in " ".join(result.out.split())
    assert "Found" not in result.out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--fix", "Tc=0.1"), "--fix: the model has no parameter Tc"),
        (("--fix", "R"), "'R' is not of the form"),
        (("--effect", "magic"), "unknown effect 'magic'"),
        (("--effect", "position_dependent_friction"), "the model needs one of"),
        (("--adapt", "0.3"), "--adapt needs a --validate capture"),
        (("--adapt", "1.5"), "--adapt must lie between 0 and 1"),
        (("--drive", "nobody"), "no drive named 'nobody'"),
    ],
)
def test_wrong_flags_are_named(capture: Path, words: tuple[str, ...], message: str) -> None:
    result = run_command("diagnose", capture, *words)
    assert result.code == 2
    assert message in result.err
    assert result.out == ""


def test_a_folder_that_cannot_be_written_is_refused_before_anything_else(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/self")):
        result = run_command("diagnose", tmp_path / "no such capture.csv", "--out", folder)
        assert result.code == 2
        assert f"--out {folder}" in result.err


def test_a_validation_capture_with_another_input_is_refused_before_anything_is_computed(
    capture: Path, tmp_path: Path
) -> None:
    other = rewritten(capture, tmp_path / "i.csv", lambda c: {k: v for k, v in c.items() if k != "voltage_V"})
    result = run_command("diagnose", capture, "--validate", other, "--progress-json")
    assert result.code == 2
    assert "i.csv: the fitted model is driven by voltage" in result.err
    assert "progress" not in result.err


@pytest.mark.parametrize(("samples", "words"), [(3, "few.csv: 3 samples are too few"), (12, "too short to diagnose")])
def test_too_few_samples_are_said_so(capture: Path, tmp_path: Path, samples: int, words: str) -> None:
    few = rewritten(capture, tmp_path / "few.csv", lambda c: {k: v[:samples] for k, v in c.items()})
    result = run_command("diagnose", few, "--json")
    assert result.code == 2
    assert words in json.loads(result.out)["error"]


def test_a_motor_that_stands_still_shows_nothing(capture: Path, tmp_path: Path) -> None:
    still = rewritten(
        capture, tmp_path / "still.csv", lambda c: {k: v if k == "time_s" else 0.0 * v for k, v in c.items()}
    )
    result = run_command("diagnose", still, "--out", tmp_path / "out")
    assert result.code == 0
    assert result.out.startswith("Nothing can be said")
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert document["verdict"] == "none"
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000


def _linear(c: Columns) -> Columns:
    return {"time_s": c["time_s"], "force_N": 0.30628 * c["current_A"], "position_m": c["position_rad"]}


def test_a_linear_axis_speaks_of_forces(capture: Path, tmp_path: Path) -> None:
    axis = rewritten(capture, tmp_path / "axis.csv", _linear)
    result = run_command("diagnose", axis, "--out", tmp_path / "out", "--json")
    document = result.document
    assert document["baseline"]["heldout_rmse"].keys() == {"position_m", "velocity_m_s"}
    assert document["baseline"]["parameters"]["J"]["unit"] == "kg"
    assert document["missing"].keys() == {"force"}
    assert document["verdict"] == "found"
    assert all(p["unit"] in ("N", "N·s/m") for p in document["effects"][0]["parameters"].values())
    html = (tmp_path / "out" / "report.html").read_text()
    assert "Missing force over position" in html
    assert "N·m" not in html


def _without(name: str) -> Callable[[Columns], Columns]:
    return lambda c: {k: v for k, v in c.items() if k != name}


@pytest.mark.slow
def test_what_is_large_and_has_no_name_is_not_nothing(tmp_path: Path) -> None:
    """A motor that lacks nothing, whose encoder loses and finds a hundredth of a turn at moments that nothing tells."""
    capture = tmp_path / "linear.csv"
    assert run_command("simulate", "--out", capture, "--seconds", "4", "--seed", "4").code == 0
    rng = np.random.default_rng(5)

    def slipping(c: Columns) -> Columns:
        slips = rng.choice([0.0, 0.06], 40).repeat(-(-len(c["time_s"]) // 40))[: len(c["time_s"])]
        return c | {"position_rad": c["position_rad"] + slips}

    path = rewritten(capture, tmp_path / "slips.csv", slipping)
    document = run_command("diagnose", path, "--out", tmp_path / "report", "--json").document
    assert document["verdict"] == "unexplained"
    assert not document["effects"]
    assert not document["remaining"]["white"]


@pytest.mark.slow
def test_without_a_voltage_the_cause_is_named_and_no_number_is_invented(capture: Path, tmp_path: Path) -> None:
    bare = rewritten(capture, tmp_path / "c.csv", _without("voltage_V"))
    document = run_command("diagnose", bare, "--json").document
    assert [e["name"] for e in document["effects"]] == ["coulomb_friction"]
    tc = document["effects"][0]["parameters"]["Tc"]
    assert (tc["value"], tc["std"], tc["status"]) == (None, None, "undetermined")
    assert any("Tc" in c["expression"] for c in document["combinations"])
    assert "Tc =" not in document["toml"]
    assert "# not determined by these data: Tc" in document["toml"]


@pytest.mark.slow
def test_without_a_current_the_models_numbers_are_the_datas_or_none(capture: Path, tmp_path: Path) -> None:
    bare = rewritten(capture, tmp_path / "c.csv", _without("current_A"))
    document = run_command("diagnose", bare, "--effect", "coulomb_friction", "--json").document
    parameters = document["baseline"]["parameters"]
    assert all((p["value"] is None) == (p["std"] is None) for p in parameters.values())
    assert parameters["R"]["value"] is parameters["Tc"]["value"] is None
    assert any("Tc" in c["expression"] for c in document["combinations"])
    assert document["missing"].keys() == {"torque"}


@pytest.mark.slow
def test_what_is_held_lets_the_rest_be_known(capture: Path, tmp_path: Path) -> None:
    bare = rewritten(capture, tmp_path / "c.csv", _without("current_A"))
    document = run_command("diagnose", bare, "--fix", "R=0.4937,K=0.30628", "--json").document
    assert document["effects"][0]["parameters"]["Tc"]["value"] == pytest.approx(TC, rel=0.05)


@pytest.mark.slow
def test_several_captures_are_diagnosed_together(capture: Path, tmp_path: Path) -> None:
    half = rewritten(capture, tmp_path / "half.csv", lambda c: {k: v[2500:] for k, v in c.items()})
    document = run_command("diagnose", capture, half, "--out", tmp_path / "out", "--json").document
    assert [e["name"] for e in document["effects"]] == ["coulomb_friction"]
    assert len(document["free_runs"]) == len(document["captures"]) == 2
    html = (tmp_path / "out" / "report.html").read_text()
    assert "Position, half.csv" in html or "Angle, half.csv" in html


def _speed_only(c: Columns) -> Columns:
    speed = np.gradient(c["position_rad"], c["time_s"])
    return {"time_s": c["time_s"], "voltage_V": c["voltage_V"], "velocity_rad_s": speed}


def _constant_speed(c: Columns) -> Columns:
    rng, n = np.random.default_rng(3), len(c["time_s"])
    return {
        "time_s": c["time_s"],
        "voltage_V": np.full(n, 12.0),
        "current_A": 3.0 + rng.normal(0.0, 0.01, n),
        "position_rad": 30.0 * c["time_s"],
    }


def _with_a_gap(c: Columns) -> Columns:
    return {k: np.concatenate([v[:2000], v[3500:]]) for k, v in c.items()}


def _at_50_hz(c: Columns) -> Columns:
    return {k: v[::20] for k, v in c.items()}


def _no_motion(c: Columns) -> Columns:
    return {k: v for k, v in c.items() if k != "position_rad"}


@pytest.mark.slow
@pytest.mark.parametrize("change", [_speed_only, _constant_speed, _with_a_gap, _at_50_hz, _no_motion])
def test_every_kind_of_capture_ends_with_an_answer(
    capture: Path, tmp_path: Path, change: Callable[[Columns], Columns]
) -> None:
    odd = rewritten(capture, tmp_path / "odd.csv", change)
    result = run_command("diagnose", odd, "--json", "--out", tmp_path)
    assert result.code in (0, 2), result.err
    answer = json.loads(result.out)
    assert answer["error"] if result.code else answer["verdict"] in ("none", "found", "unexplained")
    assert "Warning" not in result.err
    assert "Traceback" not in result.err
    if change is _constant_speed:
        assert answer["verdict"] == "none"
        assert answer["baseline"]["parameters"]["J"]["status"] == "undetermined"
