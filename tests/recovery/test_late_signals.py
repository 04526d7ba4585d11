"""A current that its sensor filters passes for an inductance: the interval holds that, the line that mends it is said,
and with it the answer is right. A voltage that is a row late, and a motion alone: the interval holds it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.samples import make_block
from tests.command_line import run_command
from tests.recovery.generator import GEAR_MOTOR, PAPER, RE40, Motor, Scenario, generate, typical
from tests.recovery.generator.sensors import filtered_speed

#: Time constant of the sensor's filter, s.
T_F = 0.003


def written(path: Path, motor: Motor, motion: str, *, filtered: bool = True, lines: str = "") -> Path:
    made = generate(motor, Scenario(motion, seconds=3.0, rate_hz=500.0, seed=41))
    current = filtered_speed(made.time_s, made.current_A, T_F) if filtered else made.current_A
    noise = np.random.default_rng(41).normal(0.0, 1e-3 * motor.rated_current_A, len(current))
    table = np.column_stack([made.time_s, made.voltage_V, current + noise, made.position_rad])
    header = f"{lines}time_s,voltage_V,current_A,position_rad"
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.10g")
    return path


def off(document: dict, motor: Motor) -> dict[str, float]:  # type: ignore[type-arg]
    """By how many standard deviations each parameter with a value is off, 2 % of it beside."""
    rows = {name: row for name, row in document["parameters"].items() if row["value"] is not None}
    true = {name: getattr(motor, name) for name in rows}
    return {n: abs(r["value"] - true[n]) / np.hypot(r["std"], 0.02 * true[n]) for n, r in rows.items()}


@pytest.mark.first_is_fast
@pytest.mark.parametrize(("motor", "motion"), [(GEAR_MOTOR, "prbs"), (RE40, "steps")])
def test_a_filtered_current_is_named_and_put_right(tmp_path: Path, motor: Motor, motion: str) -> None:
    document = run_command("fit", written(tmp_path / "filtered.csv", motor, motion), "--json").document
    assert max(off(document, motor).values()) < 4.0, off(document, motor)
    (note,) = [text for text in document["notes"] if "behind voltage and motion" in text]
    line = re.search(r"# current_late_s: ([\d.]+)", note)
    assert line and float(line[1]) == pytest.approx(T_F, abs=1.3e-3)
    mended = run_command(
        "fit", written(tmp_path / "mended.csv", motor, motion, lines=f"{line[0]}\n"), "--json"
    ).document
    assert not [text for text in mended["notes"] if "behind voltage and motion" in text]
    assert max(off(mended, motor).values()) < 4.0, off(mended, motor)
    assert {"R", "K", "J", "B"} <= off(mended, motor).keys()


def test_a_current_without_a_filter_is_not_late(tmp_path: Path) -> None:
    document = run_command(
        "fit", written(tmp_path / "clean.csv", GEAR_MOTOR, "prbs", filtered=False), "--json"
    ).document
    assert not [text for text in document["notes"] if "behind voltage and motion" in text]
    assert document["parameters"]["L"]["std"] < 0.1 * GEAR_MOTOR.L


@pytest.mark.parametrize("late", [0, 1])
def test_a_voltage_a_row_late_without_a_current(late: int) -> None:
    """Where the winding's lag is about a row nothing names it: its motor has no lag, and 30 % less inertia."""
    made = generate(PAPER, Scenario("steps", seconds=4.0, rate_hz=200.0, seed=9))
    voltage = np.append(np.full(late, made.voltage_V[0]), made.voltage_V)[: len(made.time_s)]
    block = make_block(made.time_s, voltage_V=voltage, position_rad=made.position_rad)
    fit = fit_output_error([Recording("c", block)], (), FitOptions())
    braking = PAPER.B * PAPER.R + PAPER.K**2
    (lag,) = [c for c in fit.combinations if c.expression == "(J R + L B)/(B R + K²)"]
    true = (PAPER.J * PAPER.R + PAPER.L * PAPER.B) / braking
    assert abs(lag.value - true) < 3.0 * lag.std
    assert (lag.std > 0.1 * true) == bool(late)


@pytest.mark.parametrize(
    ("motor", "motion", "rate_hz", "early"), [(RE40, "prbs", 200.0, 1), (PAPER, "multisine", 500.0, 2)]
)
def test_a_voltage_rows_early_without_a_current(
    tmp_path: Path, motor: Motor, motion: str, rate_hz: float, early: int
) -> None:
    """Its motor seems to have a slow winding, and a lag that is too long by those rows; no winding waits for a row."""
    made = generate(motor, Scenario(motion, seconds=4.0, rate_hz=rate_hz, seed=990072))
    table = np.column_stack([made.time_s, np.roll(made.voltage_V, -early), made.position_rad])
    path = tmp_path / "early.csv"
    np.savetxt(path, table, delimiter=",", header="time_s,voltage_V,position_rad", comments="", fmt="%.10g")
    document = run_command("fit", path, "--json").document
    assert any(f"rows_late = -{early}" in note for note in document["notes"])
    braking = motor.B * motor.R + motor.K**2
    true = {
        "K/(B R + K²)": motor.K / braking,
        "(J R + L B)/(B R + K²)": (motor.J * motor.R + motor.L * motor.B) / braking,
    }
    found = {c["expression"]: c for c in document["combinations"]}
    for expression, value in true.items():
        assert abs(found[expression]["value"] - value) < 4.0 * found[expression]["std"]
    assert found["K/(B R + K²)"]["std"] < 0.02 * true["K/(B R + K²)"]


def test_dry_friction_that_hides_a_late_voltage() -> None:
    """The linear motor says of neither that it explains much; the gain holds both."""
    effects = typical("coulomb_friction", RE40, 0.15, seconds=10.0)
    made = generate(RE40, Scenario("prbs", seconds=10.0, rate_hz=200.0, effects=effects, seed=990073))
    block = make_block(made.time_s, voltage_V=np.roll(made.voltage_V, 1), position_rad=made.position_rad)
    fit = fit_output_error([Recording("c", block)], (), FitOptions())
    gain = fit.combinations[0]
    assert gain.expression == "K/(B R + K²)"
    assert abs(gain.value - RE40.K / (RE40.B * RE40.R + RE40.K**2)) < 4.0 * gain.std
