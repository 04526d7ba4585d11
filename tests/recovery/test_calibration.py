"""The calibration's motors, motions and seeds are none of the matrix', and a run says what its thresholds saw."""

from __future__ import annotations

import ast
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from tests.recovery.calibration.__main__ import read
from tests.recovery.calibration.cases import STRENGTHS, CalibrationCase, diagnosed, run_case, tracked
from tests.recovery.calibration.motions import BOUNDED, MOTIONS
from tests.recovery.calibration.motors import SEEDS, motor
from tests.recovery.calibration.table import SPEAKS, table
from tests.recovery.calibration.watched import watching
from tests.recovery.generator import LISTED, MOTORS, Scenario, generate
from tests.recovery.generator import MOTIONS as OTHERS
from tests.recovery.hidden import DRAWN
from tests.recovery.hidden import STRENGTHS as OTHER_STRENGTHS

pytestmark = pytest.mark.usefixtures("generator_built")
_CONSTANTS = ("R", "L", "K", "J", "B")


def every_case() -> list[CalibrationCase]:
    return [*diagnosed(24, 1), *tracked(24, 4)]


def test_no_motor_is_one_of_the_matrix() -> None:
    """Each differs from each by a quarter at least, in one constant at least, and no two are the same."""
    drawn = [motor(c.motor) for c in every_case()]
    for own in drawn:
        for other in MOTORS.values():
            assert own.name != other.name
            assert max(abs(np.log(getattr(own, n) / getattr(other, n))) for n in _CONSTANTS) > np.log(1.25)
    assert len({own.R for own in drawn}) == len({c.motor for c in every_case()})
    assert motor(5) == motor(5)


def test_no_motion_is_one_of_the_matrix() -> None:
    assert not set(MOTIONS) & set(OTHERS)
    assert not set(STRENGTHS.values()) & set(OTHER_STRENGTHS.values())
    time_s = np.arange(6000) / 1000.0
    for own in MOTIONS.values():
        for other in OTHERS.values():
            for seed in range(3):
                a, b = (m(MOTORS["re40"], time_s, np.random.default_rng(seed)) for m in (own, other))
                assert a.mode != b.mode or np.abs(a.reference - b.reference).max() > 0.1 * np.abs(b.reference).max()


def test_no_seed_is_one_of_the_matrix_or_of_a_test(repo_root: Path) -> None:
    seeds = [c.seed for c in every_case()]
    assert len(set(seeds)) == len(seeds)
    assert all(s in SEEDS and s not in DRAWN for s in seeds)
    assert not range(max(SEEDS.start, DRAWN.start), min(SEEDS.stop, DRAWN.stop))
    for path in sorted((repo_root / "tests").rglob("*.py")):
        constants = (n.value for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, ast.Constant))
        assert not [v for v in constants if type(v) is int and v in SEEDS], path.name


def test_every_listed_cause_is_among_them_at_each_strength() -> None:
    hidden = {(c.what, c.strength) for c in diagnosed(0, 1)}
    assert {(n, s) for n in LISTED if n != "current_sensor_gain" for s in STRENGTHS} <= hidden
    assert all(c.motion in BOUNDED for c in diagnosed(0, 3) if c.what == "position_dependent_friction")


@pytest.mark.parametrize("number", range(8))
@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motor_moves_within_its_drive(number: int, motion: str) -> None:
    own = motor(number)
    truth = generate(own, Scenario(MOTIONS[motion], seconds=4.0, seed=3)).truth
    assert np.sqrt(np.mean(truth.speed_rad_s**2)) > 0.02 * own.speed_max_rad_s
    assert np.sqrt(np.mean(truth.current_A**2)) > 0.02 * own.rated_current_A
    assert np.abs(truth.current_A).max() < 1.2 * own.current_limit_A
    if motion in BOUNDED:
        assert np.abs(truth.position_rad).max() < 0.2 * own.speed_max_rad_s


def test_every_threshold_that_the_table_knows_is_there() -> None:
    with watching(
        "servo_daemon.diagnosis",
        "servo_daemon.regression",
        "servo_daemon.tracking",
        "servo_daemon.identification.output_error",
    ) as notes:
        assert sorted(set(SPEAKS) - set(notes)) == []


def test_a_run_notes_what_thresholds_were_compared_with(tmp_path: Path) -> None:
    """No step is looked for where the motor is steady; where R steps one is, and the table says so."""
    results = [
        run_case(CalibrationCase("tracker", what, "", 3, "chirps", SEEDS.start + 9), 14.0)
        for what in ("nothing", "R +25 %")
    ]
    assert "parameter_jump" not in results[0].outcome
    assert "parameter_jump" in results[1].outcome
    value, seen = results[1].seen["tracking.changes.search._CHANGED"]
    assert max(seen) > value == 60.0
    path = tmp_path / "runs.jsonl"
    path.write_text("".join(json.dumps(asdict(r)) + "\n" for r in results))
    assert read(path) == results
    lines = table(results).splitlines()
    at = lines.index("tracking.changes.search._CHANGED = 60, above")
    assert lines[at + 1].split() == ["nothing", "0", "of", "1", "runs"]
    assert "missed   0.0%" in lines[at + 2]
