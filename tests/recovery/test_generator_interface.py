"""The generator as a tool: independence, reproducibility, sensors, motions, captures, and what it refuses."""

from __future__ import annotations

import ast
import gzip
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.recovery.generator import (
    MOTIONS,
    MOTORS,
    PAPER,
    RE40,
    CompilerMissingError,
    Motor,
    Plan,
    Recording,
    Scenario,
    Sensors,
    generate,
    native,
    servo_gains,
    typical,
)

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("generator_built")]

PACKAGE = Path(native.__file__).parent
COLUMNS = ("time_s", "voltage_V", "current_A", "position_rad")


# ---- independence --------------------------------------------------------------------------------------------------


def test_its_files_import_nothing_of_what_they_test() -> None:
    """Only the standard library, NumPy and each other; the C code only the C library."""
    allowed = set(sys.stdlib_module_names) | {"numpy", "__future__"}
    for path in PACKAGE.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            assert all(name.split(".")[0] in allowed for name in names), f"{path.name} imports {names}"
            assert not (isinstance(node, ast.ImportFrom) and node.level > 1), f"{path.name} imports from outside"
    for path in PACKAGE.glob("*.[ch]"):
        included = set(re.findall(r"#include\s+(\S+)", path.read_text(encoding="utf-8")))
        assert included <= {"<math.h>", "<string.h>", '"motor.h"'}, path.name


def test_importing_and_running_it_loads_nothing_of_what_it_tests(repo_root: Path) -> None:
    code = (
        "import sys; from tests.recovery.generator import PAPER, Scenario, generate; generate(PAPER, Scenario());"
        "print([m for m in sys.modules if m.split('.')[0] in {'servo_daemon', 'drivers', 'casadi', 'scipy'}])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=repo_root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# ---- reproducibility -----------------------------------------------------------------------------------------------


def same(first: Recording, second: Recording) -> bool:
    return all(np.array_equal(getattr(first, column), getattr(second, column)) for column in COLUMNS)


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_seed_decides_everything(motion: str) -> None:
    scenario = Scenario(motion, 2.0, effects=typical("stribeck_friction", PAPER, 0.1), seed=8)
    assert same(generate(PAPER, scenario), generate(PAPER, scenario))
    assert not same(generate(PAPER, scenario), generate(PAPER, replace(scenario, seed=9)))


def test_streams_are_separate() -> None:
    """More current noise changes the shown current and nothing else."""
    lab = Sensors.laboratory(PAPER)
    quiet, noisy = (
        generate(PAPER, Scenario("steps", 1.0, sensors=replace(lab, current_noise_A=noise))) for noise in (0.0, 1.0)
    )
    assert np.array_equal(quiet.position_rad, noisy.position_rad)
    assert np.array_equal(quiet.time_s, noisy.time_s)
    assert np.std(noisy.current_A - quiet.current_A) == pytest.approx(1.0, rel=0.1)


# ---- sensors -------------------------------------------------------------------------------------------------------


def test_laboratory_sensors_show_the_truth_within_their_errors() -> None:
    lab = Sensors.laboratory(RE40)
    recording = generate(RE40, Scenario("multisine", 5.0))
    truth, count = recording.truth, 2 * np.pi / lab.counts_per_rev
    below = truth.position_rad - recording.position_rad
    assert np.all((below >= -1e-9) & (below <= count + 1e-9))
    assert np.allclose(recording.position_rad / count, np.round(recording.position_rad / count), atol=1e-6)
    error = recording.current_A - truth.current_A
    assert np.std(error) == pytest.approx(np.hypot(lab.current_noise_A, lab.current_lsb_A / 12**0.5), rel=0.05)
    assert abs(error.mean()) < 0.1 * lab.current_noise_A
    hidden = truth.applied_V[:-1] - recording.voltage_V[:-1]
    assert np.std(hidden) == pytest.approx(lab.hidden_V, rel=0.05)
    assert np.abs(recording.time_s - truth.time_s).max() <= 0.5 * lab.stamp_lsb_s + 1e-12
    assert np.std(truth.time_s - np.arange(len(truth.time_s)) / 1000) == pytest.approx(lab.jitter_s, rel=0.05)
    assert np.all(np.diff(recording.time_s) > 0)


def test_hidden_noise_within_the_interval_averages_out() -> None:
    plan = Plan("voltage", np.zeros(4000))
    sensors = Sensors(hidden_V=1.0, hidden_pieces=16)
    truth = generate(PAPER, Scenario(plan, 4.0, sensors=sensors)).truth
    assert np.std(truth.applied_V[:-1]) == pytest.approx(1 / 4, rel=0.05)
    assert truth.current_A.std() > 0


def test_pwm_sampled_in_its_centre_shows_the_mean_current() -> None:
    """Bipolar 20 kHz: the current ripples by about an ampere, its samples and the mean voltage do not."""
    plan = Plan("voltage", np.full(200, 5.0))
    switched = generate(RE40, Scenario(plan, 0.2, sensors=Sensors(pwm_hz=20e3)))
    smooth = generate(RE40, Scenario(plan, 0.2, sensors=Sensors()))
    assert np.allclose(switched.truth.applied_V, 5.0)
    assert np.allclose(switched.current_A, smooth.current_A, atol=0.02 * smooth.current_A.max())
    assert not np.array_equal(switched.current_A, smooth.current_A)


# ---- motions -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(
    ("motor", "rate_hz"),
    [*((motor, 1000.0) for motor in MOTORS.values()), (PAPER, 200.0)],
    ids=lambda value: getattr(value, "name", value),
)
def test_motions_move_every_motor_within_its_limits(motion: str, motor: Motor, rate_hz: float) -> None:
    recording = generate(motor, Scenario(motion, 12.0, rate_hz, effects=typical("coulomb_friction", motor, 0.05)))
    truth = recording.truth
    assert np.abs(recording.voltage_V).max() <= motor.supply_V * 1.001
    assert np.abs(truth.current_A).max() < 1.3 * motor.current_limit_A
    assert np.abs(truth.speed_rad_s).max() < motor.speed_max_rad_s
    assert truth.speed_rad_s.max() > 0.03 * motor.speed_max_rad_s
    assert truth.speed_rad_s.min() < -0.03 * motor.speed_max_rad_s
    assert truth.current_A.std() > 0.05 * motor.rated_current_A


@pytest.mark.parametrize("motor", MOTORS.values(), ids=MOTORS)
def test_servo_arrives(motor: Motor) -> None:
    """One step of a tenth of a turn: there within a few counts, with little overshoot."""
    target = np.full(3000, 0.6)
    truth = generate(motor, Scenario(Plan("position", target), 3.0)).truth
    assert np.abs(truth.position_rad[-500:] - 0.6).max() < 0.01
    assert truth.position_rad.max() < 0.75


def test_the_integral_does_not_wind_up_at_the_current_limit() -> None:
    """A step of the speed that takes ten times as long as the loop's own answer, at the limit all the way."""
    heavy = replace(RE40, J=20 * RE40.J)
    target = np.full(1500, 0.7 * RE40.speed_max_rad_s)
    truth = generate(heavy, Scenario(Plan("speed", target, gains=servo_gains(RE40, 1000.0)), 1.5)).truth
    assert np.mean(truth.current_A > 0.9 * RE40.current_limit_A) > 0.5
    assert truth.speed_rad_s[-1] == pytest.approx(target[0], rel=0.02)
    assert truth.speed_rad_s.max() < 1.05 * target[0]


# ---- captures ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["capture.csv", "capture.csv.gz"])
def test_a_capture_holds_the_four_columns_and_no_truth(tmp_path: Path, name: str) -> None:
    recording = generate(PAPER, Scenario("steps", 1.0, effects=typical("gravity_load", PAPER, 0.1)))
    recording.write_csv(tmp_path / name)
    raw = (tmp_path / name).read_bytes()
    lines = (gzip.decompress(raw) if name.endswith(".gz") else raw).decode().splitlines()
    comments = [line for line in lines if line.startswith("#")]
    assert comments == ["# source: independent generator", "# rate_hz: 1000", "# counts_per_rev: 16384"]
    assert lines[len(comments)] == ",".join(COLUMNS)
    table = np.array([[float(cell) for cell in line.split(",")] for line in lines[len(comments) + 1 :]])
    expected = np.column_stack([getattr(recording, column) for column in COLUMNS])
    assert np.allclose(table, expected, rtol=1e-8, atol=1e-9)


# ---- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scenario", "complaint"),
    [
        (Scenario(effects={"coulomb": {"Tc": 0.1}}), "no effect 'coulomb'"),
        (Scenario(effects={"coulomb_friction": {}}), "has the parameters"),
        (Scenario(effects={"coulomb_friction": {"Tc": 0.1, "Ts": 0.2}}), "has the parameters"),
        (Scenario(effects={"coulomb_friction": {"Tc": -0.1}}), "must not be negative"),
        (Scenario(effects={"coulomb_friction": {"Tc": float("nan")}}), "not a finite number"),
        (
            Scenario(effects={"coulomb_friction": {"Tc": 0.1}, "stribeck_friction": {"Tc": 0.2, "Ts": 0.3, "ws": 1.0}}),
            "contradicts",
        ),
        (Scenario(effects={"position_dependent_friction": {"Tc_slope": 0.1, "Tc_curve": 0.0}}), "name one"),
        (
            Scenario(effects=typical("backlash", PAPER, 0.1) | typical("shaft_compliance", PAPER, 0.1)),
            "name one of them",
        ),
        (Scenario(effects={"measurement_delay": {"t_d": 0.001, "channel": "voltage_V"}}), "is none of"),
        (Scenario(effects={"shaft_compliance": {"k_s": 1e9, "c_s": 0.0, "J_l": 1e-6}}), "too stiff"),
        (Scenario(effects={"magnetic_saturation": {"I_sat": 0.0}}), "must be positive"),
        (Scenario("waltz"), "no motion 'waltz'"),
        (Scenario(Plan("voltage", np.zeros(7))), "the motion has 7 samples"),
        (Scenario(seconds=0.0), "at least two"),
        (Scenario(ageing={"Tc": np.zeros(20000)}), "does not age"),
        (Scenario(ageing={"R": np.ones(5)}), "ageing of R"),
        (Scenario(ageing={"J": np.zeros(20000)}), "ageing of J"),
        (Scenario(sensors=Sensors(jitter_s=1e-4, stamp_lsb_s=1e-3)), "would repeat"),
    ],
    ids=lambda value: value.replace(" ", "-") if isinstance(value, str) else "",
)
def test_what_makes_no_sense_is_refused(scenario: Scenario, complaint: str) -> None:
    with pytest.raises(ValueError, match=re.escape(complaint)):
        generate(PAPER, scenario)


def test_without_a_compiler_the_error_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "find_compiler", lambda: None)
    build: Callable[[], object] = native.library.__wrapped__
    with pytest.raises(CompilerMissingError, match="needs a C compiler"):
        build()
