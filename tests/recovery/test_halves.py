"""Another day: a model of one half of the EMPS capture predicts the other half, and a day with more friction."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import read_capture
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.identification.output_error.problem.score import score, slope
from servo_daemon.identification.procedure.settle import settled_coordinates
from servo_daemon.samples import F64, SampleBlock, make_block
from tests.command_line import run_command

#: Friction as published (Janot, Gautier & Brunot 2019), N and N·s/m: forwards, backwards.
_DRY_N, _VISCOUS = (20.144, 20.628), (166.71, 240.42)
_STANDS_M_S = 1e-3


@pytest.fixture(scope="module")
def axis(servo_data: Path) -> F64:
    """Shape (n, 3): time_s, force_N, position_m."""
    block = read_capture(servo_data / "emps_train.csv.gz").block()
    assert block.torque_Nm is not None
    assert block.position_rad is not None
    return np.column_stack([block.time_s, block.torque_Nm, block.position_rad])


def capture(path: Path, rows: F64) -> Path:
    np.savetxt(path, rows, delimiter=",", header="time_s,force_N,position_m", comments="", fmt="%.9g")
    return path


def friction_N(rows: F64) -> F64:
    speed = slope(rows[:, 2], rows[:, 0])
    forwards = speed > 0
    dry, viscous = (np.where(forwards, *pair) for pair in (_DRY_N, _VISCOUS))
    return np.asarray(np.where(np.abs(speed) > _STANDS_M_S, np.sign(speed) * dry + viscous * speed, 0.0))


def another_day(rows: F64) -> F64:
    """The same motion with 3 % more friction: it has taken so much more force."""
    day = rows.copy()
    day[:, 1] += 0.03 * friction_N(rows)
    return day


def scores(fitted: Path, other: Path) -> Mapping[str, Mapping[str, float]]:
    """By kind: mm/s of one free run, mm of free runs of 1 s."""
    effects = ("--effect", "asymmetric_friction", "--effect", "position_dependent_friction")
    words = (*effects, "--segment", "0.5", "--validate", other, "--adapt", "0.3", "--json")
    (row,) = run_command("fit", fitted, *words).document["validation"]
    return {
        kind: {"speed": 1e3 * row[kind]["rmse"]["velocity_m_s"], "angle": 1e3 * row[kind]["rmse_1s"]["position_m"]}
        for kind in ("baseline", "extended", "adapted")
    }


@pytest.mark.parametrize("way", [1, -1], ids=["second from first", "first from second"])
def test_friction_of_the_same_day_does_not_settle_anew(axis: F64, tmp_path: Path, way: int) -> None:
    """3.7 s, a motion or two, show how friction varies from motion to motion: settled on them it predicts the rest to
    4.0 and 3.7 mm/s."""
    half, other = np.array_split(axis, 2)[::way]
    found = scores(capture(tmp_path / "half.csv", half), capture(tmp_path / "other.csv", other))
    assert 10.0 < found["baseline"]["speed"] < 30.0
    assert 0.8 < found["extended"]["speed"] < 2.0
    assert 0.2 < found["extended"]["angle"] < 0.7
    assert 0.8 < found["adapted"]["speed"] < 1.2 * found["extended"]["speed"]
    assert 0.2 < found["adapted"]["angle"] < 1.2 * found["extended"]["angle"]


def test_more_friction_on_another_day_settles(axis: F64, tmp_path: Path) -> None:
    half = np.array_split(axis, 2)[0]
    found = scores(capture(tmp_path / "half.csv", half), capture(tmp_path / "day.csv", another_day(axis)))
    assert 2.5 < found["extended"]["speed"] < 6.0
    assert 0.8 < found["adapted"]["speed"] < 0.6 * found["extended"]["speed"]
    assert 0.2 < found["adapted"]["angle"] < 0.6 * found["extended"]["angle"]


def test_what_has_settled_is_told(axis: F64, tmp_path: Path) -> None:
    first, second = np.array_split(axis, 2)
    half, other = capture(tmp_path / "half.csv", first), capture(tmp_path / "other.csv", second)
    day = capture(tmp_path / "day.csv", another_day(axis))
    words = ("--effect", "asymmetric_friction", "--validate", other, day, "--adapt", "0.3", "--out")
    told = run_command("fit", half, *words, tmp_path / "report").out
    assert "nothing settled" in told
    settled = r"settled on the first part: (B \S+, )?Tc \S+, Tc_neg "  # more of dry and of all friction are alike here
    assert re.search(settled, told)
    page = (tmp_path / "report" / "report.html").read_text()
    assert "Adapted: nothing settled" in page
    assert re.search("Adapted: " + settled, page)


@pytest.mark.parametrize("half", [0, 1])
def test_one_scale_of_all_friction_settles_where_that_is_what_changed(axis: F64, half: int) -> None:
    """3 % more friction: one scale of it all, and not four numbers of their own."""
    effects = ("asymmetric_friction", "position_dependent_friction")
    fitted, other = np.array_split(axis, 2)[half], another_day(axis)
    fit = fit_output_error([Recording("half", _block(fitted))], effects, FitOptions(segment_s=0.5))
    plant, q = fit.problem.plant, fit.coordinates()
    first, rest = np.split(other, [round(0.3 * len(other))])
    candidate, then = settled_coordinates(_block(first), plant, q, len(q))
    scale = np.exp(then - q)[[plant.parameter_names.index(n) for n in ("B", "B_neg", "Tc", "Tc_neg")]]
    assert "all friction" in candidate.words
    assert scale == pytest.approx(np.full(4, 1.03), abs=0.01)
    before, after = (score(_block(rest), plant, x).rmse["velocity_rad_s"] for x in (q, then))
    assert after < 0.35 * before
    # ... and on the same day nothing does
    same = np.array_split(axis, 2)[1 - half]
    nothing, _ = settled_coordinates(_block(same[: round(0.3 * len(same))]), plant, q, 1)
    assert nothing.words == "nothing"


def _block(rows: F64) -> SampleBlock:
    return make_block(rows[:, 0], torque_Nm=rows[:, 1], position_rad=rows[:, 2])
