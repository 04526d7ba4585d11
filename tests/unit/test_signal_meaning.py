"""What voltage and current mean: conversion at the door, the other equivalents, keys and metadata lines."""

from __future__ import annotations

import math
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from drivers.base import DriveInfo
from servo_daemon.captures import read_capture, write_capture
from servo_daemon.captures.driver import ReplayDriver
from servo_daemon.config import DriveConfig, parse_config
from servo_daemon.daemon.diagnosis.files import capture_metadata
from servo_daemon.errors import BadInputError, CaptureError, ConfigError
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.samples import concatenate, make_block
from servo_daemon.signal_meaning import SignalMeaning, as_texts, keys_of_texts, told

#: The q axis of a motor of 0.05 Ω and 20 µH a phase, 7 pole pairs, 2 mWb.
R, L, FLUX, POLES = 0.05, 20e-6, 2e-3, 7


def q_axis(i: float, speed: float) -> float:
    return R * i + POLES * FLUX * speed


@pytest.mark.parametrize(
    ("publish", "expected"),
    [
        ("phase", (R, math.sqrt(1.5) * POLES * FLUX)),
        ("line", (2 * R, math.sqrt(3) * POLES * FLUX)),
        ("kt", (1.5 * R, 1.5 * POLES * FLUX)),
    ],
)
def test_dq_becomes_the_dc_motor_that_is_asked_for(publish: str, expected: tuple[float, float]) -> None:
    i, w = np.array([3.0, -2.0]), np.array([10.0, 40.0])
    v = np.array([q_axis(*x) for x in zip(i, w, strict=True)])
    block = SignalMeaning("instant", convention="dq", publish=publish).converted(
        make_block(np.array([0.0, 1.0]), voltage_V=v, current_A=i)
    )
    assert block.voltage_V is not None and block.current_A is not None
    found = np.linalg.solve(np.column_stack([block.current_A, w]), block.voltage_V)
    assert found == pytest.approx(expected)
    assert block.voltage_V * block.current_A == pytest.approx(1.5 * v * i)  # the power


@pytest.mark.parametrize(("one", "other"), [*permutations(("phase", "line", "kt"), 2)])
def test_equivalents_lead_from_any_choice_to_any_other(one: str, other: str) -> None:
    there = SignalMeaning(convention="dq", publish=one).equivalents()
    assert set(there) == {"phase", "line", "kt"} - {one}
    back = SignalMeaning(convention="dq", publish=other).equivalents()[one]
    for name in ("R", "L", "K"):
        assert there[other][name] * back[name] == pytest.approx(1.0)
    table = {"phase": (1.0, math.sqrt(1.5)), "line": (2.0, math.sqrt(3)), "kt": (1.5, 1.5)}
    assert there[other]["R"] == pytest.approx(table[other][0] / table[one][0])
    assert there[other]["K"] == pytest.approx(table[other][1] / table[one][1])


def test_a_dc_motor_has_no_equivalents_and_its_samples_stay() -> None:
    block = make_block(np.arange(3.0), voltage_V=np.ones(3))
    assert SignalMeaning().converted(block) is block
    assert SignalMeaning("mean").equivalents() == {}


def test_behind_a_gear_the_motion_is_that_of_the_motors_shaft() -> None:
    block = make_block(np.arange(2.0), position_rad=np.ones(2), velocity_rad_s=np.ones(2), torque_Nm=np.ones(2))
    block = SignalMeaning(gear_ratio=20.0).converted(block)
    assert block.position_rad is not None and block.velocity_rad_s is not None and block.torque_Nm is not None
    assert (block.position_rad[0], block.velocity_rad_s[0], block.torque_Nm[0]) == pytest.approx((20.0, 20.0, 0.05))


def test_what_is_cut_off_toward_zero_is_put_back_on_average() -> None:
    true = np.random.default_rng(1).normal(0.0, 1.0, 20_000)
    cut = np.trunc(true / 0.1) * 0.1
    block = SignalMeaning(truncated_A=0.1).converted(make_block(np.arange(20_000.0), current_A=cut))
    assert block.current_A is not None
    slope = float(block.current_A @ true / (true @ true))
    assert float(cut @ true / (true @ true)) < 0.97
    assert slope == pytest.approx(1.0, abs=5e-3)
    assert block.current_A[cut == 0.0] == pytest.approx(0.0)


def test_a_mean_current_says_so_whatever_becomes_of_the_block() -> None:
    block = SignalMeaning("mean", "mean").converted(make_block(np.arange(4.0), current_A=np.ones(4)))
    parts = block.slice(0, 2), block.slice(2, 4).select(np.array([True, False]))
    assert all(part.current_mean for part in (block, *parts, concatenate(parts)))
    assert not make_block(np.arange(4.0), current_A=np.ones(4)).current_mean


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"voltage": "average"}, "voltage"),
        ({"current": "held"}, "current"),
        ({"convention": "abc"}, "convention"),
        ({"publish": "star"}, "publish"),
        ({"pole_pairs": 0}, "pole_pairs"),
        ({"gear_ratio": -1.0}, "gear_ratio"),
        ({"truncated_A": math.nan}, "truncated_A"),
    ],
)
def test_what_cannot_be_is_refused_by_name(given: dict[str, object], named: str) -> None:
    with pytest.raises(BadInputError, match=named):
        SignalMeaning(**given)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=rf"drive\[0\]\.signals\.{named}"):
        parse_config({"drive": [{"signals": given}]})


def test_keys_of_the_configuration_stand_above_the_drivers_word() -> None:
    drive = parse_config({"drive": [{"signals": {"voltage": "instant", "publish": "line"}}]}).drive[0]
    said = SignalMeaning("mean", "mean", "dq", pole_pairs=7)
    assert drive.signals.meaning(said) == SignalMeaning("instant", "mean", "dq", "line", 7)
    assert parse_config({}).drive[0].signals.meaning(said) == said
    with pytest.raises(ConfigError, match="unknown key"):
        parse_config({"drive": [{"signals": {"volts": "mean"}}]})


def test_metadata_lines_come_back() -> None:
    meaning = SignalMeaning("mean", "mean", "dq", "kt", 7, 9.5, 0.1, 0.01)
    assert SignalMeaning(**keys_of_texts(as_texts(meaning))) == meaning


def _file(folder: Path, *lines: str) -> Path:
    path = folder / "c.csv"
    rows = "\n".join(f"{k / 100},{k},{k},{k}" for k in range(20))
    head = "\n".join(f"# {line}" for line in lines)
    path.write_text(f"{head}\ntime_s,voltage_V,current_A,position_rad\n{rows}\n", encoding="utf-8")
    return path


def test_a_captures_own_lines_stand_above_a_configuration(tmp_path: Path) -> None:
    capture = read_capture(_file(tmp_path, "voltage: mean", "convention: dq"))
    found = capture.meaning(SignalMeaning("instant", publish="kt"))
    assert found == SignalMeaning("mean", convention="dq", publish="kt")
    converted = capture.as_dc(capture.meaning())
    assert converted.meaning() == SignalMeaning("mean")
    assert converted.current_A is not None and converted.current_A[2] == pytest.approx(2 * math.sqrt(1.5))
    assert converted.as_dc(converted.meaning()).current_A == pytest.approx(converted.current_A)  # once


def test_a_wrong_line_is_named_with_its_place(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"c\.csv, line 2: metadata voltage = 'avg' is none of held, instant, mean"):
        read_capture(_file(tmp_path, "axis: rotary", "voltage: avg"))
    with pytest.raises(CaptureError, match="gear_ratio"):
        read_capture(_file(tmp_path, "gear_ratio: -3"))


def test_a_note_of_the_supply_is_no_meaning(tmp_path: Path) -> None:
    assert read_capture(_file(tmp_path, "voltage: 24 V")).meaning() == SignalMeaning()


def test_a_replayed_capture_is_a_driver_that_says_what_it_means(tmp_path: Path) -> None:
    block = make_block(np.arange(20) / 100.0, voltage_V=np.ones(20), current_A=np.ones(20), position_rad=np.ones(20))
    path = tmp_path / "c.csv"
    write_capture(path, block, metadata=as_texts(SignalMeaning("mean", "mean", "dq")))
    with ReplayDriver("axis1", {"path": str(path), "speed": 0}) as driver:
        assert driver.meaning == SignalMeaning("mean", "mean", "dq")


def test_a_ring_holds_what_was_converted_and_its_capture_says_so() -> None:
    """Else a diagnosis would convert it once more."""
    meaning, ring = SignalMeaning("mean", "mean", "dq", "kt", gear_ratio=2.0), SampleRing(60.0)
    t = np.arange(200) / 100.0
    ones = np.ones(200)
    pipeline = Pipeline(DriveConfig(), ring=ring, meaning=meaning)
    pipeline.process(make_block(t, voltage_V=ones, current_A=ones, position_rad=t), rows=False)
    kept = ring.blocks()[0]
    assert kept.voltage_V is not None and kept.voltage_V[0] == pytest.approx(1.5)
    assert kept.position_rad is not None and kept.position_rad[5] == pytest.approx(2.0 * t[5])
    texts = capture_metadata(DriveConfig(), DriveInfo("x"), "0", meaning)
    said = SignalMeaning(**keys_of_texts(texts))
    assert said == meaning.as_dc and said.factors == (1.0, 1.0) and said.voltage == "mean"
    assert "voltage" not in capture_metadata(DriveConfig(), DriveInfo("x"), "0", SignalMeaning())


def test_of_a_voltage_that_a_drive_does_not_have_nothing_is_said() -> None:
    odrive = SignalMeaning("instant", "instant", "dq", "kt")
    assert told(odrive).startswith("voltage instant, current instant, dq")
    assert told(odrive, ("current_A", "position_rad")).startswith("current instant, dq")
