"""The signal map: what it does to CSV and Parquet, and the one line for everything that is wrong in it."""

from __future__ import annotations

import importlib
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servo_daemon.captures import load_signal_map, read_capture
from servo_daemon.errors import CaptureError, ConfigError, ServoDaemonError
from servo_daemon.samples import Quality

N = 20


def mapped(folder: Path, text: str) -> Path:
    path = folder / "map.toml"
    path.write_text(text)
    return path


def foreign_csv(folder: Path, header: str = "t_ms,U [V],I [mA],Winkel,Duty\n", extra: str = "") -> Path:
    rows = "".join(f"{10 * k},{k},{100 * k},{(50 * k) % 360},{k / N}\n" for k in range(N))
    path = folder / "foreign.csv"
    path.write_text("# mass_kg: 0.49\n" + header + rows + extra)
    return path


GOOD = """
[signals]
time_s = { signal = "t_ms", scale = 1e-3 }
voltage_V = { formula = "Duty * Supply", Duty = "Duty", Supply = { signal = "U [V]", offset = 1.0 } }
current_A = { signal = "I [mA]", scale = 0.001, offset = -0.5 }
position_rad = { signal = "Winkel", scale = 0.017453292519943295, wrap = 6.283185307179586 }
[metadata]
arm_length_m = 0.1
mass_kg = 0.5
"""


def test_foreign_columns_are_renamed_scaled_combined_and_unwrapped(tmp_path: Path) -> None:
    capture = read_capture(foreign_csv(tmp_path), mapped(tmp_path, GOOD))
    k = np.arange(N)
    assert capture.time_s == pytest.approx(k * 0.01)
    assert capture.voltage_V == pytest.approx(k / N * (k + 1.0))
    assert capture.current_A == pytest.approx(0.1 * k - 0.5)
    assert capture.position_rad == pytest.approx(np.radians(50.0 * k))
    assert (capture.mass_kg, capture.arm_length_m, capture.notes) == (0.5, 0.1, ())
    assert not capture.quality().any()


@pytest.mark.parametrize(("late", "kept", "first"), [(2, range(N - 2), 2), (-3, range(3, N), 0)])
def test_a_column_rows_away_is_brought_to_its_own(tmp_path: Path, late: int, kept: range, first: int) -> None:
    moved = GOOD.replace("offset = -0.5", f"rows_late = {late}")
    capture = read_capture(foreign_csv(tmp_path), mapped(tmp_path, moved))
    assert capture.time_s == pytest.approx(0.01 * np.array(kept))
    assert capture.current_A == pytest.approx(0.1 * np.arange(first, first + len(kept)))
    assert capture.as_map["signals"]["current_A"]["rows_late"] == late


def test_map_object_and_file_are_the_same(tmp_path: Path) -> None:
    path, text = foreign_csv(tmp_path), mapped(tmp_path, GOOD)
    one, other = read_capture(path, text), read_capture(path, load_signal_map(str(text)))
    np.testing.assert_array_equal(one.block().voltage_V, other.block().voltage_V)


def test_columns_that_the_map_does_not_name_may_hold_anything(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time_s,t,voltage_V,u,i\n12:00,0,x,1,2\n12:00,1,,3,4\n")
    capture = read_capture(path, mapped(tmp_path, 'signals = { time_s = "t", voltage_V = "u", current_A = "i" }'))
    assert capture.time_s.tolist() == [0.0, 1.0]
    assert capture.notes == ("signals not used: time_s, voltage_V",)


def test_encoder_counts(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time_s,enc,i\n" + "".join(f"{k},{(k * 20_000) % 65_536},1\n" for k in range(9)))
    text = 'counts_per_rev = -4096\nsignals = { position_counts = { signal = "enc", wrap = 65536 }, current_A = "i" }'
    capture = read_capture(path, mapped(tmp_path, text))
    assert capture.position_rad == pytest.approx(-np.arange(9) * 20_000 * 2 * math.pi / 4096)
    assert capture.counts_per_rev == 4096


def test_linear_axis(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time_s,x,F\n0,1,2\n1,2,3\n2,2,3\n9,2,3\n")
    capture = read_capture(path, mapped(tmp_path, 'signals = { position_m = "x", force_N = "F" }'))
    assert (capture.axis, capture.channels) == ("linear", ("position_rad", "torque_Nm"))
    assert capture.quality()[-1] == Quality.GAP_BEFORE


def test_without_a_map_the_lines_that_would_do_are_shown(tmp_path: Path) -> None:
    """And they do: with the only guess that stays open filled in, the proposal is a map that works."""
    path = foreign_csv(tmp_path, header="t_ms,U [V],I [mA],Winkel [deg],Angle [rad]\n")
    with pytest.raises(CaptureError) as caught:
        read_capture(path)
    text = str(caught.value)
    assert "line 2: the motion is not understood; the file holds t_ms, U [V], I [mA], Winkel [deg], Angle [rad]" in text
    assert "; which is position_rad: Winkel [deg] or Angle [rad]?; say which signal is which: " in text
    assert "\n" not in text and "…" not in text
    capture = read_capture(path, mapped(tmp_path, text[text.index("signals = {") : text.index("; needed")]))
    assert capture.time_s[1] == pytest.approx(0.01)
    assert capture.current_A is not None and capture.current_A[1] == pytest.approx(0.1)
    assert capture.position_rad is not None and capture.position_rad[1] == pytest.approx(math.radians(50))


BAD_MAPS = {
    "no toml": ("signals = {", "not a signal map in TOML: "),
    "unknown key": ("columns = 3", "unknown key 'columns': known are signals, metadata, sheet"),
    "no table": ("signals = 3", "signals must be a table"),
    "no signals": ("[metadata]\nmass_kg = 1", "the table [signals] is missing"),
    "metadata": ("[metadata]\nmass_kg = [1]\n", "metadata: mass_kg must be a text or a number, not [1]"),
    "option": (
        'sheet = "a"\nsignals = { time_s = "t_ms" }',
        "sheet: not an option for CSV, which takes counts_per_rev",
    ),
    "unknown column": ('signals = { speed = "n" }', "signals: unknown column 'speed': known are time_s, voltage_V"),
    "both positions": ('signals = { position_rad = "a", position_counts = "a" }', "exclude each other"),
    "counts": ('signals = { position_counts = "a" }', "position_counts needs counts_per_rev"),
    "no counts": ("counts_per_rev = 0\nsignals = { position_counts = 'a' }", "counts_per_rev must not be 0"),
    "counts text": ("counts_per_rev = 'x'\nsignals = { position_counts = 'a' }", "counts_per_rev must be a number"),
    "neither": ("signals = { time_s = { scale = 2 } }", 'signals: time_s: must be "name", {signal = "name", …} or'),
    "both": ("signals = { time_s = { signal = 'a', formula = 'b' } }", "time_s: must be"),
    "not a text": ("signals = { time_s = { signal = 3 } }", 'time_s: must be "name" or {signal'),
    "unknown operand": ("signals = { time_s = { signal = 'a', unit = 's' } }", "unknown key 'unit': known are signal,"),
    "scale 0": ("signals = { time_s = { signal = 'a', scale = 0 } }", "scale is 0"),
    "scale": ("signals = { time_s = { signal = 'a', scale = nan } }", "scale must be a number, not nan"),
    "wrap": ("signals = { time_s = { signal = 'a', wrap = -1 } }", "wrap must be positive, not -1.0"),
    "column": ("signals = { time_s = { signal = 'a', column = 0 } }", "column must be a whole number from 1 on, not 0"),
    "column and row": ("signals = { time_s = { signal = 'a', column = 1, row = 1 } }", "exclude each other"),
    "group": ("signals = { time_s = { signal = 'a', group = 1.5 } }", "group must be a number or a name, not 1.5"),
    "formula": ("signals = { time_s = { formula = 3 } }", "formula must be a text"),
    "formula syntax": ("signals = { time_s = { formula = 'a +' } }", "is no formula"),
    "formula name": ("signals = { time_s = { formula = 'a + b', a = 'a' } }", "uses 'b', which is not given a signal"),
    "formula extra": ("signals = { time_s = { formula = 'a', a = 'a', b = 'b' } }", "unknown key 'b'"),
    "formula constant": ("signals = { time_s = { formula = '3' } }", "the formula uses no signal"),
}


@pytest.mark.parametrize("name", BAD_MAPS)
def test_bad_map_is_one_line_naming_the_place(tmp_path: Path, name: str) -> None:
    text, message = BAD_MAPS[name]
    path = mapped(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        read_capture(foreign_csv(tmp_path), path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_map_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: No such file"):
        read_capture(foreign_csv(tmp_path), tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b"# \xd9\n")
    with pytest.raises(ConfigError, match=r"latin\.toml: not a signal map in TOML: "):
        read_capture(foreign_csv(tmp_path), tmp_path / "latin.toml")


MAP = 'signals = { time_s = { signal = "t_ms", scale = 1e-3 }, voltage_V = "U [V]", current_A = "I [mA]" }'


@pytest.mark.parametrize(
    ("signals", "extra", "message"),
    [
        (MAP, "200,,1,1,1\n", "line 23, column U [V]: the cell is empty"),
        (MAP, "\n200,x,1,1,1\n", "line 24, column U [V]: 'x' is not a number"),
        (MAP, "200,nan,1,1,1\n", "line 23, column U [V]: 'nan' is not a finite number"),
        (MAP, "\n190,1,1,1,1\n", "line 24, column t_ms: time is repeated: 0.19 after 0.19"),
        (MAP, "5,1,1,1,1\n", "line 23, column t_ms: time jumps back: 0.005 after 0.19"),
        (MAP.replace("U [V]", "Uarm"), "", "line 2, column Uarm: no such column; there are t_ms, U [V], I [mA]"),
        (MAP.replace('"U [V]"', '{ signal = "U [V]", column = 2 }'), "", "column U [V] column 2: no such column"),
        (MAP.replace(', current_A = "I [mA]"', ""), "", "no usable set of columns among: time_s, voltage_V; needed: "),
        (
            MAP.replace('time_s = { signal = "t_ms", scale = 1e-3 }, ', ""),
            "",
            "no time: map time_s, or say --rate; the file holds t_ms",
        ),
        (
            MAP.replace('"U [V]"', '{ formula = "1 / U", U = "U [V]" }'),
            "",
            "line 3, column voltage_V: the formula '1 / U' has no finite value",
        ),
        (MAP + '\n[metadata]\nmass_kg = "x"', "", "metadata mass_kg: 'x' is not a number greater than zero"),
    ],
)
def test_bad_capture_through_a_map(tmp_path: Path, signals: str, extra: str, message: str) -> None:
    path = foreign_csv(tmp_path, extra=extra)
    with pytest.raises(CaptureError) as caught:
        read_capture(path, mapped(tmp_path, signals))
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("t_ms,U [V],I [mA]\n", "line 1: a header but no rows: at least 2 samples are needed"),
        ("t_ms,U [V],I [mA]\n1,2,3\n", "line 2: only one sample: at least 2 samples are needed"),
        ("t_ms;U [V];I [mA]\n0;1,5;2\n", "line 2: only one sample: at least 2 samples are needed"),
        ("t_ms,U [V],U [V],I [mA]\n1,2,3,4\n2,3,4,5\n", "line 1, column U [V]: the column is there twice"),
    ],
)
def test_too_little_or_too_much(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(content)
    with pytest.raises(CaptureError) as caught:
        read_capture(path, mapped(tmp_path, MAP))
    assert message in str(caught.value)


@pytest.fixture
def parquet() -> Any:
    pytest.importorskip("pyarrow", reason="pyarrow (extra 'parquet') is not installed")
    return importlib.import_module("pyarrow.parquet")


def write_table(parquet: Any, path: Path, **columns: list[Any]) -> Path:
    parquet.write_table(importlib.import_module("pyarrow").table(columns), path)
    return path


def test_parquet_through_a_map(tmp_path: Path, parquet: Any) -> None:
    path = write_table(parquet, tmp_path / "a.parquet", t=[0, 10, 20], u=[1.0, 2.0, 3.0], i=[0.5, 0.25, 0.0])
    signals = mapped(
        tmp_path, 'signals = { time_s = { signal = "t", scale = 0.001 }, voltage_V = "u", current_A = "i" }'
    )
    capture = read_capture(path, signals)
    assert capture.time_s.tolist() == [0.0, 0.01, 0.02]
    assert capture.current_A is not None and capture.current_A.tolist() == [0.5, 0.25, 0.0]
    with pytest.raises(CaptureError, match=r"no column time_s; the file holds t \(3\), .*if in ms: time_s = {"):
        read_capture(path)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"t": [0, 1], "u": [1.0, None], "i": [1, 1]}, "row 2, column u: the value is missing (NaN)"),
        ({"t": [0, 0], "u": [1.0, 2.0], "i": [1, 1]}, "row 2, column t: time is repeated: 0.0 after 0.0"),
        ({"t": [0, 1], "u": ["1", "2"], "i": [1, 1]}, "column u: holds string, not numbers"),
        ({"t": [0, 1], "i": [1, 1]}, "column u: no such column; there are t (2), i (2)"),
        ({"t": [0], "u": [1], "i": [1]}, "1 sample: at least 2 are needed"),
    ],
)
def test_bad_parquet_through_a_map(tmp_path: Path, parquet: Any, columns: dict[str, list[Any]], message: str) -> None:
    path = write_table(parquet, tmp_path / "a.parquet", **columns)
    signals = mapped(tmp_path, 'signals = { time_s = "t", voltage_V = "u", current_A = "i" }')
    with pytest.raises(ServoDaemonError) as caught:
        read_capture(path, signals)
    assert message in str(caught.value)


def test_the_maps_in_the_documentation_are_maps(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "captures.md").read_text()
    examples = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    assert len(examples) == 5
    for example in examples:
        signal_map = load_signal_map(mapped(tmp_path, example))
        assert "dbc" in signal_map.options or signal_map.columns()
