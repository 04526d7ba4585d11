"""Columns that do not mean what their names say are named with the line that mends it, and then the answer is right.
On captures that mean what they say nothing is named."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.captures.columns.plausible import check_time_unit, plausibility_notes
from servo_daemon.captures.meaning import excluded_values, findings, without_unusable
from servo_daemon.errors import CaptureError
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.samples import F64
from tests.recovery.generator import BELT_SERVO, GEAR_MOTOR, LARGE_SERVO, MOTORS, PAPER, RE40, Motor, Scenario, generate

_TURN = 2 * np.pi
_COLUMNS = ("voltage_V", "current_A", "position_rad")


def columns(motor: Motor, motion: str = "multisine", rate_hz: float = 500.0, seed: int = 1) -> dict[str, F64]:
    """Time, voltage, current, angle, and the true speed with a little noise."""
    made = generate(motor, Scenario(motion, seconds=8, rate_hz=rate_hz, seed=seed))
    noise = np.random.default_rng(seed).normal(0.0, 1e-3 * motor.speed_max_rad_s, len(made.time_s))
    return {
        "time_s": made.time_s,
        **{name: getattr(made, name) for name in _COLUMNS},
        "velocity_rad_s": made.truth.speed_rad_s + noise,
    }


def capture(of: dict[str, F64], *names: str) -> Capture:
    return Capture(Path("c.csv"), **{name: of[name] for name in ("time_s", *(names or _COLUMNS))})  # type: ignore[arg-type]


def write(path: Path, of: dict[str, F64], *names: str) -> Path:
    chosen = ("time_s", *(names or _COLUMNS))
    table = np.column_stack([of[name] for name in chosen])
    np.savetxt(path, table, delimiter=",", header=",".join(chosen), comments="", fmt="%.10g")
    return path


def mended(path: Path, text: str, above: str = "", **put: str) -> Capture:
    """The capture read with the line that a finding offers; `put` replaces what only the user knows."""
    line = re.search(r"signals = \{.*\} \}|signals = \{.*\}", text)
    assert line, text
    told = line[0]
    for key, value in put.items():
        told = re.sub(rf"{key} = [\d.e-]+", f"{key} = {value}", told)
    made = path.with_suffix(".toml")
    made.write_text(f"{above}{told}\n")
    return read_capture(path, made)


def right(of: Capture, motor: Motor) -> None:
    """The motor's parameters come out, within 4 of their std or 2 %."""
    fit = fit_output_error([Recording("c", of.block())], (), FitOptions())
    for name in ("R", "K", "J", "B"):
        p = fit.parameters[name]
        assert p.value is not None and p.std is not None, name
        true = getattr(motor, name)
        assert abs(p.value - true) < max(4 * p.std, 0.02 * true), (name, p.value, p.std, true)


@pytest.mark.parametrize("motor", [*MOTORS.values(), BELT_SERVO], ids=lambda m: m.name)
@pytest.mark.parametrize("motion", ["multisine", "steps", "reversals", "pick_and_place", "prbs"])
def test_clean_captures_are_not_doubted(motor: Motor, motion: str) -> None:
    for rate_hz, seed in ((1000.0, 3), (60.0, 4)):
        of = columns(motor, motion, rate_hz, seed)
        for names in (_COLUMNS, ("voltage_V", "position_rad"), ("current_A", "position_rad"), tuple(of)[1:]):
            assert findings(capture(of, *names)) == (), (rate_hz, names)
        assert excluded_values(capture(of), {"K": motor.K}) == []


def test_an_offset_and_a_load_do_not_make_a_modulus() -> None:
    """Currents that never change sign, for reasons of their own."""
    of = columns(GEAR_MOTOR, "reversals", 200.0)
    assert findings(capture({**of, "current_A": of["current_A"] + np.ptp(of["current_A"])})) == ()
    effects = {"constant_load_torque": {"TL": 0.4 * GEAR_MOTOR.working_torque_Nm}}
    hoist = generate(GEAR_MOTOR, Scenario("reversals", seconds=12, rate_hz=500, effects=effects, seed=5))
    held = {"time_s": hoist.time_s, **{name: getattr(hoist, name) for name in _COLUMNS}}
    assert np.percentile(held["current_A"], 1) > 0.0 > np.percentile(held["voltage_V"], 12)
    assert findings(capture(held)) == ()


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motor", [PAPER, RE40, LARGE_SERVO, BELT_SERVO], ids=lambda m: m.name)
def test_a_modulus_gets_its_signs_back(tmp_path: Path, motor: Motor) -> None:
    of = columns(motor, "multisine", 1000.0)
    path = write(tmp_path / "abs.csv", {**of, "current_A": np.abs(of["current_A"])})
    read = read_capture(path)
    (found,) = findings(read)
    assert "|i|" in found.text
    assert without_unusable(read, [found]).channels == ("voltage_V", "position_rad")
    good = mended(path, found.text)
    assert good.current_A is not None
    clear = np.abs(of["current_A"]) > 0.1 * np.max(np.abs(of["current_A"]))
    assert np.mean(np.sign(good.current_A[clear]) == np.sign(of["current_A"][clear])) > 0.99
    right(good, motor)


@pytest.mark.parametrize("motor", [PAPER, GEAR_MOTOR, BELT_SERVO], ids=lambda m: m.name)
def test_the_supply_s_current_becomes_the_motor_s(tmp_path: Path, motor: Motor) -> None:
    of = columns(motor, "multisine", 1000.0)
    supplied = of["current_A"] * of["voltage_V"] / motor.supply_V
    path = write(tmp_path / "supply.csv", {**of, "current_A": supplied})
    (found,) = findings(read_capture(path))
    assert "supply" in found.text
    good = mended(path, found.text, supply_V=f"{motor.supply_V}")
    assert good.current_known is not None and 0.5 < np.mean(good.current_known) < 1.0
    right(good, motor)


_UNITS: dict[str, tuple[tuple[str, ...], str, Callable[[dict[str, F64]], F64], str, dict[str, str]]] = {
    "counts": (
        _COLUMNS,
        "position_rad",
        lambda of: np.round(of["position_rad"] / _TURN * 8192),
        "counts_per_rev = 8192\n",
        {},
    ),
    "degrees": (
        _COLUMNS,
        "position_rad",
        lambda of: np.floor(of["position_rad"] / _TURN * 4096) * (360 / 4096),
        "",
        {},
    ),
    "turns": (_COLUMNS, "position_rad", lambda of: np.floor(of["position_rad"] / _TURN * 4096) / 4096, "", {}),
    "rpm": (
        ("voltage_V", "current_A", "velocity_rad_s"),
        "velocity_rad_s",
        lambda of: np.round(of["velocity_rad_s"] * 60 / _TURN),
        "",
        {},
    ),
    "milliamperes": (_COLUMNS, "current_A", lambda of: np.round(1e3 * of["current_A"]), "", {}),
    "millivolts": (_COLUMNS, "voltage_V", lambda of: np.round(1e3 * of["voltage_V"]), "", {}),
    "code": (_COLUMNS, "voltage_V", lambda of: np.round(of["voltage_V"] / 12 * 1000), "", {}),
    "wrap": (_COLUMNS, "position_rad", lambda of: np.mod(of["position_rad"], _TURN), "", {}),
}


@pytest.mark.parametrize("kind", _UNITS)
def test_units_are_named_and_mended(tmp_path: Path, kind: str) -> None:
    names, field, dressed, above, put = _UNITS[kind]
    of = columns(GEAR_MOTOR, "multisine", 1000.0, seed=7)
    path = write(tmp_path / "unit.csv", {**of, field: dressed(of)}, *names)
    found = findings(read_capture(path))
    assert found and found[0].column == field, found
    if kind == "code":
        put = {"scale": "0.012"}
    right(mended(path, found[0].text, above, **put), GEAR_MOTOR)


@pytest.mark.parametrize("names", [_COLUMNS, ("current_A", "position_rad")])
def test_counts_about_a_zero_are_asked_about(tmp_path: Path, names: tuple[str, ...]) -> None:
    of = columns(GEAR_MOTOR, "multisine", 1000.0, seed=7)
    per_count = 2.0 * GEAR_MOTOR.current_limit_A / 4096
    read = read_capture(
        write(tmp_path / "adc.csv", {**of, "current_A": np.round(of["current_A"] / per_count) + 2048}, *names)
    )
    (found,) = findings(read)
    zero = re.search(r'formula = "\(Value - (\d+)\) \* 0\.01"', found.text)
    assert zero and abs(float(zero[1]) - 2048.0) <= 2.0 and "zero at about 2,0" in found.text
    with_scale = found.text.replace("* 0.01", f"* {per_count}")
    if "voltage_V" in names:
        assert "current_A" not in without_unusable(read, [found]).channels
        right(mended(tmp_path / "adc.csv", with_scale), GEAR_MOTOR)
    else:
        with pytest.raises(CaptureError, match="amperes a count"):
            without_unusable(read, [found])


@pytest.mark.parametrize(("scale", "words"), [(60 / _TURN, "rpm"), (180 / np.pi, "degrees"), (-1.0, "against")])
def test_speed_and_angle_must_agree(scale: float, words: str) -> None:
    of = columns(GEAR_MOTOR)
    found = findings(capture({**of, "velocity_rad_s": scale * of["velocity_rad_s"]}, *_COLUMNS, "velocity_rad_s"))
    assert found and words in found[0].text


@pytest.mark.parametrize("field", ["torque_Nm", "current_A", "voltage_V"])
@pytest.mark.parametrize("motor", [PAPER, GEAR_MOTOR], ids=lambda m: m.name)
def test_an_effort_against_the_motion(field: str, motor: Motor) -> None:
    of = columns(motor, "steps" if field == "voltage_V" else "multisine", 200.0)
    of["torque_Nm"] = motor.K * of["current_A"]
    assert findings(capture(of, field, "position_rad")) == ()
    (found,) = findings(capture({**of, field: -of[field]}, field, "position_rad"))
    assert found.column == field and "scale = -1" in found.text


def test_a_full_counter_refuses_with_its_range(tmp_path: Path) -> None:
    """And says that it counts, and what has to be known of it."""
    of = columns(PAPER, rate_hz=1000.0)
    counts = np.mod(np.floor(of["position_rad"] / _TURN * PAPER.counts_per_rev) + 65_000, 65_536)
    path = write(tmp_path / "full.csv", {**of, "position_rad": counts})
    read = read_capture(path)
    with pytest.raises(CaptureError, match=r"16 bits.* wrap = 65536.*counts_per_rev") as refused:
        without_unusable(read, findings(read))
    made = mended(path, str(refused.value), above=f"counts_per_rev = {PAPER.counts_per_rev}\n")
    assert made.position_rad is not None
    steps = np.diff(made.position_rad) - np.diff(of["position_rad"])
    assert np.max(np.abs(steps)) < 1.5 * _TURN / PAPER.counts_per_rev


def test_an_angle_in_degrees_that_wraps_is_mended_at_once(tmp_path: Path) -> None:
    of = columns(GEAR_MOTOR)
    path = write(tmp_path / "turn.csv", {**of, "position_rad": np.mod(np.degrees(of["position_rad"]), 360.0)})
    made = mended(path, findings(read_capture(path))[0].text)
    assert made.position_rad is not None
    assert np.diff(made.position_rad) == pytest.approx(np.diff(of["position_rad"]), abs=1e-7)


def test_one_count_of_a_held_shaft_is_no_counter() -> None:
    of = columns(GEAR_MOTOR)
    step = _TURN / GEAR_MOTOR.counts_per_rev
    held = np.where(np.arange(len(of["time_s"])) % 1000 < 600, 0.0, step)
    assert findings(capture({**of, "position_rad": held})) == ()


def test_a_mend_is_told_by_the_files_own_names_and_units(tmp_path: Path) -> None:
    of = columns(GEAR_MOTOR, rate_hz=1000.0)
    turn = GEAR_MOTOR.counts_per_rev / _TURN
    own = {
        "t_ms": 1e3 * of["time_s"],
        "pwm": 255 * of["voltage_V"] / 12.0,
        "mA": -1e3 * of["current_A"],
        "enc": np.mod(np.round(of["position_rad"] * turn), 65_536),
    }
    path = tmp_path / "own.csv"
    np.savetxt(path, np.column_stack(list(own.values())), delimiter=",", header=",".join(own), comments="", fmt="%.10g")
    options = ReadOptions(counts_per_rev=GEAR_MOTOR.counts_per_rev, supply_V=12.0, full_duty=255.0)
    (text,) = plausibility_notes(read_capture(path, options=options))
    above = re.search(r"above it +(counts_per_rev = \d+)", text)
    assert above, text
    made = mended(path, text, above=f"{above[1]}\n")
    for name in _COLUMNS[:2]:
        assert getattr(made, name) == pytest.approx(of[name], abs=1e-6), name
    assert made.position_rad is not None
    assert np.ptp(made.position_rad - of["position_rad"]) < 1.1 / turn


@pytest.mark.parametrize("motor", [RE40, GEAR_MOTOR], ids=lambda m: m.name)
def test_milliseconds_called_microseconds_say_their_line(tmp_path: Path, motor: Motor) -> None:
    of = columns(motor, "reversals")
    path = write(tmp_path / "us.csv", {**of, "time_s": 1e-3 * of["time_s"]})
    (text,) = plausibility_notes(read_capture(path))
    assert "milliseconds that are called µs" in text
    assert mended(path, text).time_s == pytest.approx(of["time_s"])


def test_a_wrong_sample_is_no_counter() -> None:
    of = columns(PAPER)
    of["position_rad"][1000] += 10 * np.ptp(of["position_rad"])
    assert findings(capture(of)) == ()


def test_a_clock_that_starts_again_says_its_range(tmp_path: Path) -> None:
    of = columns(PAPER)
    of["time_s"] = np.mod(of["time_s"] + 4294.0, 4294.967296)
    with pytest.raises(CaptureError, match=r"wrap = 4294\.967296"):
        read_capture(write(tmp_path / "micros.csv", of))


@pytest.mark.parametrize("factor", [1.5, 180 / np.pi])
def test_a_given_k_that_the_voltage_excludes(factor: float) -> None:
    of = columns(GEAR_MOTOR, "reversals")
    (text,) = excluded_values(capture(of), {"K": factor * GEAR_MOTOR.K})
    assert "cannot be" in text and ("degrees" in text) == (factor > 2)


@pytest.mark.parametrize(("field", "symbol"), [("current_A", "R"), ("position_rad", "K")])
def test_a_turned_sign_beside_a_voltage_says_its_line(tmp_path: Path, field: str, symbol: str) -> None:
    of = columns(GEAR_MOTOR, "multisine", 1000.0)
    path = write(tmp_path / "sign.csv", {**of, field: -of[field]})
    (text,) = plausibility_notes(read_capture(path))
    assert f"counts against voltage_V (v = R i + K ω has {symbol}" in text
    right(mended(path, text), GEAR_MOTOR)


def test_milliseconds_say_their_line(tmp_path: Path) -> None:
    of = columns(GEAR_MOTOR, "multisine", 1000.0)
    path = write(tmp_path / "ms.csv", {**of, "time_s": 1e3 * of["time_s"]})
    with pytest.raises(CaptureError, match="milliseconds") as refused:
        check_time_unit(read_capture(path))
    right(mended(path, str(refused.value)), GEAR_MOTOR)
