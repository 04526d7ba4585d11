"""Options of the CAN driver, the signal map and its formulas: every mistake is refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can.bus import CanDriver
from drivers.can.formula import MAX_LENGTH, parse_formula
from drivers.registry import make_driver
from servo_daemon.errors import DriverConfigError

DBC = """
VERSION ""
NS_ :
BS_:
BU_: X
BO_ 256 Status1: 8 X
 SG_ MotorCurrent : 7|16@0- (0.01,0) [0|0] "A" X
 SG_ Micros : 16|32@1+ (1e-06,0) [0|0] "s" X
BO_ 257 Status2: 8 X
 SG_ Duty : 0|16@1- (0.0001,0) [0|0] "" X
BO_ 258 Status3: 8 X
 SG_ BusVoltage : 0|16@1+ (0.1,0) [0|0] "V" X
 SG_ Real : 16|32@1- (1,0) [0|0] "" X
BO_ 259 Feedback: 8 X
 SG_ Counts : 0|16@1+ (1,0) [0|0] "" X
 SG_ Tick : 16|32@1+ (1e-06,0) [0|0] "s" X
 SG_ Counter : 48|8@1+ (1,0) [0|0] "" X
BO_ 260 Long: 64 X
 SG_ Nine : 3|64@1+ (1,0) [0|0] "" X
SIG_VALTYPE_ 258 Real : 1;
"""


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    path = tmp_path / "axis.dbc"
    path.write_text(DBC)
    return path


def vendor(dbc: Path, signals: Any, **more: Any) -> CanDriver:
    return CanDriver("axis", {"interface": "virtual", "dbc": str(dbc), "signals": signals, **more})


def refused(dbc: Path, signals: Any, **more: Any) -> str:
    with pytest.raises(DriverConfigError) as caught:
        vendor(dbc, signals, **more)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_the_map_of_the_issue(dbc: Path) -> None:
    driver = vendor(
        dbc,
        {
            "position_counts": "Feedback.Counts",
            "current_A": {"signal": "Status1.MotorCurrent", "scale": -1.0, "offset": 0.2},
            "voltage_V": {"formula": "Duty * Supply", "Duty": "Status2.Duty", "Supply": "Status3.BusVoltage"},
            "time_s": "Feedback.Tick",
        },
        counts_per_rev=4096,
        period_s=0.001,
    )
    assert driver.info.channels == ("voltage_V", "current_A", "position_rad")
    assert driver.info.counts_per_rev == 4096
    assert driver.info.sample_period_s == 0.001
    assert "Feedback" in driver.info.identity


def test_a_signal_that_is_not_there_is_named_with_those_that_are(dbc: Path) -> None:
    text = refused(dbc, {"current_A": "Status1.Current"})
    assert "Status1.Current" in text
    assert "MotorCurrent" in text
    assert "current_A" in text
    assert str(dbc) in text
    text = refused(dbc, {"current_A": "Status9.Current"})
    assert "Status9" in text
    assert "Status1, Status2, Status3" in text


@pytest.mark.parametrize(
    ("signals", "named"),
    [
        ({}, "signals"),
        ("Status1.MotorCurrent", "signals"),
        ({"curent_A": "Status1.MotorCurrent"}, "curent_A"),
        ({"current_A": "MotorCurrent"}, "MotorCurrent"),
        ({"current_A": 3}, "current_A"),
        ({"current_A": {"signal": "Status1.MotorCurrent", "scael": 2}}, "scael"),
        ({"current_A": {"signal": "Status1.MotorCurrent", "scale": "2"}}, "scale"),
        ({"current_A": {"signal": "Status1.MotorCurrent", "scale": True}}, "scale"),
        ({"current_A": {"signal": "Status1.MotorCurrent", "scale": 0}}, "scale"),
        ({"current_A": {"signal": "Status1.MotorCurrent", "offset": float("nan")}}, "offset"),
        ({"current_A": {"signal": "Status1.MotorCurrent", "stale_s": -1}}, "stale_s"),
        ({"current_A": {"signal": "Status1.MotorCurrent", "wrap": 0}}, "wrap"),
        ({"current_A": {"signal": "Status1.MotorCurrent", "formula": "1"}}, "signal"),
        ({"voltage_V": {"formula": "Duty * Supply", "Duty": "Status2.Duty"}}, "Supply"),
        ({"voltage_V": {"formula": "Duty", "Duty": "Status2.Duty", "Extra": "Status2.Duty"}}, "Extra"),
        ({"voltage_V": {"formula": "Duty", "Duty": {"signal": "Status2.Duty", "wrap": 2}}}, "wrap"),
        ({"voltage_V": {"formula": "12"}}, "signal"),
        ({"voltage_V": {"formula": 12}}, "formula"),
        ({"time_s": "Feedback.Tick"}, "position_rad"),
        ({"time_s": {"formula": "T", "T": "Feedback.Tick"}, "position_counts": "Feedback.Counts"}, "time_s"),
        ({"position_counts": "Feedback.Counts", "time_s": "Status1.Micros"}, "Feedback.Counts"),
        ({"position_counts": "Feedback.Counts", "sequence": "Status1.Micros"}, "sequence"),
        ({"velocity_rad_s": "Status3.BusVoltage", "sequence": "Status3.Real"}, "Status3.Real"),
        ({"position_counts": "Feedback.Counts", "position_rad": "Feedback.Counts"}, "position_counts"),
        ({"position_counts": "Feedback.Counts"}, "counts_per_rev"),
        ({"velocity_rad_s": "Long.Nine"}, "Long.Nine"),
    ],
)
def test_mistakes_in_the_map_are_named(dbc: Path, signals: Any, named: str) -> None:
    assert named in refused(dbc, signals)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"drive_id": 1}, "drive_id"),
        ({"trigger": "Status2"}, "Status2"),
        ({"stale_s": 0}, "stale_s"),
        ({"period_s": "1 ms"}, "period_s"),
        ({"counts_per_rev": 0}, "counts_per_rev"),
    ],
)
def test_mistakes_beside_the_map_are_named(dbc: Path, options: dict[str, Any], named: str) -> None:
    assert named in refused(dbc, {"current_A": "Status1.MotorCurrent"}, **options)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({}, "interface"),
        ({"interface": 1}, "interface"),
        ({"interface": "virtual", "chanel": "x"}, "chanel"),
        ({"interface": "virtual", "channel": 1.5}, "channel"),
        ({"interface": "virtual", "bitrate": "1M"}, "bitrate"),
        ({"interface": "virtual", "bitrate": 0}, "bitrate"),
        ({"interface": "virtual", "drive_id": 0}, "drive_id"),
        ({"interface": "virtual", "drive_id": 32}, "drive_id"),
        ({"interface": "virtual", "drive_id": True}, "drive_id"),
        ({"interface": "virtual", "bus": 5}, "bus"),
        ({"interface": "virtual", "bus": {"channel": "x"}}, "channel"),
        ({"interface": "virtual", "stale_s": 1.0}, "stale_s"),
        ({"interface": "virtual", "signals": {"current_A": "A.B"}}, "dbc"),
        ({"interface": "virtual", "dbc": "x.dbc"}, "signals"),
        ({"interface": "virtual", "counts_per_rev": float("inf")}, "counts_per_rev"),
    ],
)
def test_mistakes_in_the_options_are_named(options: dict[str, Any], named: str) -> None:
    with pytest.raises(DriverConfigError, match=named):
        make_driver("can", "axis", options)


def test_a_dbc_that_is_missing_or_none(tmp_path: Path) -> None:
    signals = {"current_A": "A.B"}
    missing, text, empty = tmp_path / "missing.dbc", tmp_path / "text.dbc", tmp_path / "empty.dbc"
    text.write_text("this is\nno DBC")
    empty.write_text('VERSION ""\nBU_: X\n')
    for path in (missing, text, empty, tmp_path):
        assert str(path) in refused(path, signals)


@pytest.mark.parametrize("scaling", ["(0,0)", "(1e400,0)", "(1,-1e400)"])
def test_a_scale_that_leaves_no_value_is_an_error(tmp_path: Path, scaling: str) -> None:
    path = tmp_path / "axis.dbc"
    signal = f'SG_ Current : 0|16@1- {scaling} [0|0] "A" X'
    path.write_text(f'VERSION ""\nBU_: X\nBO_ 256 Status: 8 X\n {signal}\n')
    text = refused(path, {"current_A": "Status.Current"})
    assert "Status.Current has scale" in text and "leave no value of it" in text


# ---- formulas


def test_a_formula_is_arithmetic_over_blocks() -> None:
    formula = parse_formula("-(Duty + 1) * Supply / 2 - min(abs(Duty), 0.5) + sqrt(Supply) * sign(Duty)", "here")
    duty, supply = np.array([-1.0, 0.0, 0.25]), np.array([24.0, 25.0, 36.0])
    expected = -(duty + 1) * supply / 2 - np.minimum(np.abs(duty), 0.5) + np.sqrt(supply) * np.sign(duty)
    assert formula.names == ("Duty", "Supply")
    assert np.allclose(formula({"Duty": duty, "Supply": supply}), expected)
    assert not np.isfinite(parse_formula("1 / A", "here")({"A": np.zeros(2)})).any()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "A +",
        "A ** 9",
        "A if B else A",
        "A > B",
        "A.__class__",
        "A[0]",
        "__import__('os').system('true')",
        "open('x')",
        "(lambda: 1)()",
        "abs(A, B)",
        "min(A)",
        "abs(x=A)",
        "abs(*A)",
        "'text'",
        "True",
        "1j",
        "1e999",
        "[A]",
        "A; B",
        "A\nB",
        "\0",
        "(" * 400 + "A" + ")" * 400,
        "A" * (MAX_LENGTH + 1),
    ],
)
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(DriverConfigError, match="here"):
        parse_formula(text, "here")


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.text(alphabet="AB01.+-*/()[]{}' ,_=:abssqrtminmax\n", max_size=40))
def test_arbitrary_text_is_a_formula_or_a_typed_error(text: str) -> None:
    try:
        formula = parse_formula(text, "here")
    except DriverConfigError as error:
        assert str(error).startswith("here")
    else:
        values = formula({name: np.array([1.0, -2.0]) for name in formula.names})
        assert values.dtype == np.float64
