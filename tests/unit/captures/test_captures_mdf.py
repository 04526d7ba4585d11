"""MDF files, written by asammdf, and what brings signals of different sampling to one time."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture, write_capture
from servo_daemon.captures.columns.time_base import Timed, to_one_time
from servo_daemon.errors import BadInputError, CaptureError
from servo_daemon.samples import F64, make_block

T = np.arange(200) / 997
U, A, Q = np.sin(T * 90), np.cos(T * 70), T * 3.0


@pytest.fixture(autouse=True)
def asammdf() -> Any:
    return pytest.importorskip("asammdf", reason="asammdf (extra 'mdf') is not installed")


def measured(
    path: Path, groups: Sequence[Sequence[tuple[str, str, F64, F64]]], version: str = "4.10", **save: Any
) -> Path:
    """An MDF file: for each group its channels (name, unit, time, values)."""
    library = importlib.import_module("asammdf")
    with library.MDF(version=version) as file:
        for number, channels in enumerate(groups):
            signals = [
                library.Signal(values, time_s, name=name, unit=unit, encoding="utf-8" if name == "text" else None)
                for name, unit, time_s, values in channels
            ]
            file.append(signals, acq_name=f"task {number}", common_timebase=True)
        saved = file.save(path, overwrite=True, **save)  # with the ending of its version, whatever is asked for
    return Path(saved).rename(path)


def plain(path: Path, **options: Any) -> Path:
    names = (("voltage_V", "V", U), ("current_A", "A", A), ("position_rad", "rad", Q))
    return measured(path, [[(name, unit, T, values) for name, unit, values in names]], **options)


def read(path: Path, signals: str) -> Capture:
    text = path.with_name("map.toml")
    text.write_text(signals)
    return read_capture(path, text)


@pytest.mark.parametrize("options", [{}, {"compression": 2}, {"version": "3.30"}, {"version": "2.14"}])
def test_round_trip(tmp_path: Path, options: dict[str, Any]) -> None:
    write_capture(tmp_path / "a.csv", make_block(T, voltage_V=U, current_A=A, position_rad=Q))
    meant = read_capture(tmp_path / "a.csv")
    capture = read_capture(plain(tmp_path / "a.mf4", **options))
    assert (capture.channels, capture.notes) == (meant.channels, ())
    for name in ("time_s", *meant.channels):
        np.testing.assert_array_equal(getattr(capture, name), getattr(meant, name))


def test_different_sampling_is_brought_to_the_times_of_the_position(tmp_path: Path) -> None:
    """Voltage at 0.5 kHz, current at 2 kHz, position at 1 kHz, each with a phase of its own; temperature at 10 Hz."""
    time_s = {"U": 0.0003 + np.arange(500) * 2e-3, "I": np.arange(2000) * 5e-4, "x": 0.0001 + np.arange(1000) * 1e-3}
    tenth = np.arange(1, 9) * 0.1
    groups = [
        [("U", "V", time_s["U"], np.arange(500.0))],
        [("I", "mA", time_s["I"], 1000.0 * time_s["I"])],
        [("x", "deg", time_s["x"], time_s["x"])],
        [("temperature_C", "°C", tenth, 20 + tenth)],
    ]
    path = measured(tmp_path / "a.mf4", groups)
    lines = 'voltage_V = "U", current_A = { signal = "I", scale = 0.001 }, position_rad = "x"'
    capture = read(path, f'signals = {{ {lines}, temperature_C = "temperature_C" }}')
    # The first position comes before the first voltage, the last two after the last current.
    kept = time_s["x"][(time_s["x"] >= 0.0003) & (time_s["x"] <= time_s["I"][-1])]
    np.testing.assert_array_equal(capture.time_s, kept)
    np.testing.assert_allclose(capture.current_A, kept, rtol=1e-12)
    np.testing.assert_array_equal(capture.position_rad, kept)
    # From 1.1 to 2.1 ms the voltage is 0; from 2.1 to 3.1 ms it is 0 for 0.2 ms, then 1 for 0.8 ms.
    assert capture.voltage_V is not None
    assert capture.voltage_V[:4] == pytest.approx([0.0, 0.8, 1.0, 1.8], abs=1e-9)
    assert capture.temperature_C is not None
    assert capture.temperature_C[[0, 500, -1]] == pytest.approx([20.1, 20 + kept[500], 20.8])
    assert capture.notes[0] == (
        "4 signals with different sampling, brought to the times of position_rad: voltage_V held (its mean from each "
        "sample to the next); current_A, temperature_C interpolated"
    )
    assert capture.notes[1].startswith(f"{1000 - len(kept)} of 1000 samples left out, where a signal has not begun")
    by_current = read(path, f'time_base = "current_A"\nsignals = {{ {lines} }}')
    assert by_current.sample_period_s == pytest.approx(5e-4)
    assert "brought to the times of current_A" in by_current.notes[1]


def test_a_silent_signal_is_not_bridged() -> None:
    time_s = np.arange(100.0)
    gap = (time_s < 40) | (time_s >= 60)
    one, values, keep = to_one_time(
        {
            "position_rad": Timed(time_s, time_s),
            "current_A": Timed(time_s[gap], time_s[gap]),
            "voltage_V": Timed(time_s[::50], np.array([3.0, 4.0])),
        },
        "position_rad",
    )
    assert one is time_s
    np.testing.assert_array_equal(keep, gap & (time_s <= 100))
    np.testing.assert_array_equal(values["current_A"][keep], time_s[keep])
    assert values["voltage_V"][[0, 49, 50, 99]].tolist() == [3.0, 3.0, 4.0, 4.0]  # commands come when they change


def test_mean_voltage_keeps_its_integral() -> None:
    """What the winding gets between two samples is the integral of the voltage: none of it is lost."""
    rng = np.random.default_rng(3)
    fast = np.cumsum(rng.uniform(1e-5, 2e-4, 200_000)) + 1.7e9
    voltage = 1e3 + rng.normal(size=len(fast))
    slow = np.linspace(fast[10], fast[-10], 2_001)
    _, values, keep = to_one_time(
        {"position_rad": Timed(slow, slow), "voltage_V": Timed(fast, voltage)}, "position_rad"
    )
    assert keep.all()
    got = np.sum(values["voltage_V"][:-1] * np.diff(slow))
    inside = np.concatenate([[slow[0]], fast[(fast > slow[0]) & (fast < slow[-1])], [slow[-1]]])
    meant = np.sum(voltage[np.searchsorted(fast, inside[:-1], side="right") - 1] * np.diff(inside))
    assert got == pytest.approx(meant, rel=1e-9)
    fine = fast[(fast > slow[7]) & (fast < slow[8])]
    edges = np.concatenate([[slow[7]], fine, [slow[8]]])
    mean = np.average(voltage[np.searchsorted(fast, edges[:-1], side="right") - 1], weights=np.diff(edges))
    assert values["voltage_V"][7] == pytest.approx(mean, rel=1e-6)


def test_a_formula_over_groups_holds_the_slower(tmp_path: Path) -> None:
    groups = [
        [("duty", "", T, U), ("i", "A", T, A)],
        [("bus", "V", T[3::10], np.arange(20.0)), ("x", "", T[3::10], Q[3::10])],
    ]
    path = measured(tmp_path / "a.mf4", groups)
    formula = '{ formula = "Duty * Bus", Duty = "duty", Bus = "bus" }'
    capture = read(path, f'signals = {{ voltage_V = {formula}, current_A = "i" }}')
    bus = (np.arange(len(T)) - 3) // 10
    np.testing.assert_array_equal(capture.time_s, T[3:])
    np.testing.assert_allclose(capture.voltage_V, (U * bus)[3:])


def test_group_and_time_channel(tmp_path: Path) -> None:
    groups = [[("U", "V", T, U), ("i", "A", T, A), ("ticks", "", T, np.arange(200.0))], [("U", "V", T + 1, -U)]]
    path = measured(tmp_path / "a.mf4", groups)
    with pytest.raises(CaptureError, match=r"column U: the channel is in several groups \(0 \(task 0\), 1 \(task 1"):
        read(path, 'signals = { voltage_V = "U", current_A = "i" }')
    for group in ("0", '"task 0"'):
        chosen = f'voltage_V = {{ signal = "U", group = {group} }}, current_A = "i"'
        capture = read(path, f"signals = {{ {chosen} }}")
        np.testing.assert_array_equal(capture.voltage_V, U)
    capture = read(path, f'signals = {{ {chosen}, time_s = {{ signal = "ticks", scale = 0.01 }} }}')
    np.testing.assert_allclose(capture.time_s, np.arange(200) * 0.01)
    with pytest.raises(CaptureError, match=r"column U group task 1: not sampled with time_s \(ticks\): leave time"):
        read(path, f'signals = {{ {chosen.replace("0", "1")}, time_s = "ticks" }}')
    with pytest.raises(CaptureError, match=r"column U group 7: not in group 7, but in 0 \(task 0\), 1 \(task 1\)"):
        read(path, 'signals = { voltage_V = { signal = "U", group = 7 }, current_A = "i" }')


@pytest.mark.parametrize(
    ("voltage", "message"),
    [
        ('"Uarm"', "column Uarm: no such channel; there are U, i, nan, text, 2D, 2D[0], 2D[1], 2D[2], one"),
        ('"nan"', "sample 5, column nan: the value is missing (NaN)"),
        ('"text"', "column text: holds text, not numbers"),
        ('"2D"', "column 2D: holds arrays, not numbers"),
        ('"one"', "column one: 1 sample: at least 2 are needed"),
        ('"late"', "the signals have no time in common: voltage_V 100 … 100.2 s, current_A 0 …"),
        ('"again"', "sample 2, column again: time is repeated: 0.0 after 0.0"),
        ('{ signal = "U", row = 1 }', "an MDF channel has no 'column' or 'row'"),
    ],
)
def test_bad_mdf_is_one_line_naming_the_place(tmp_path: Path, voltage: str | None, message: str) -> None:
    words = np.array([b"ab"] * len(T))
    table = np.rec.fromarrays([np.ones((len(T), 3))], dtype=np.dtype([("2D", "(3,)<f8")]))
    groups = [
        [("U", "V", T, U), ("i", "mA", T, A), ("nan", "", T, np.where(T[4] == T, np.nan, U)), ("text", "", T, words)],
        [("2D", "", T, table)],
        [("one", "", T[:1], U[:1])],
        [("late", "", T + 100, U)],
        [("again", "", np.zeros(3), U[:3])],
    ]
    path = measured(tmp_path / "a.mf4", groups)
    with pytest.raises(CaptureError) as caught:
        if voltage is None:
            read_capture(path)
        else:
            read(path, f'signals = {{ voltage_V = {voltage}, current_A = "i" }}')
    text = str(caught.value)
    assert text.startswith(str(path)) and message in text and "\n" not in text


@pytest.mark.parametrize("version", ["4.10", "3.30"])
def test_cut_off_anywhere_is_one_line_and_nothing_else(
    tmp_path: Path, version: str, capfd: pytest.CaptureFixture[str]
) -> None:
    whole = plain(tmp_path / "a.mf4", version=version).read_bytes()
    hook = sys.unraisablehook
    for part in (1, 9, 19):
        path = tmp_path / "cut.mf4"
        path.write_bytes(whole[: len(whole) * part // 20])
        with pytest.raises(CaptureError, match="not a usable MDF file, or cut off: ") as caught:
            read_capture(path)
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")
    assert sys.unraisablehook is hook


def test_without_asammdf_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = plain(tmp_path / "a.mf4")
    real = importlib.import_module

    def without(name: str, package: str | None = None) -> ModuleType:
        if name.startswith("asammdf"):
            raise ModuleNotFoundError(f"No module named {name!r}")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(BadInputError, match=r"MDF needs asammdf: pip install 'servo-daemon\[mdf\]'") as caught:
        read_capture(path)
    assert caught.value.exit_code == 2


def test_channels_are_understood_by_name_and_unit(tmp_path: Path) -> None:
    path = measured(tmp_path / "a.mf4", [[("Uarm", "V", T, U), ("Iarm", "mA", T, 1e3 * A)], [("Angle", "deg", T, Q)]])
    capture = read_capture(path)
    assert capture.channels == ("voltage_V", "current_A", "position_rad")
    assert capture.current_A is not None and capture.position_rad is not None
    np.testing.assert_allclose(capture.current_A, A, rtol=1e-12)
    np.testing.assert_allclose(capture.position_rad, np.radians(Q), rtol=1e-12)
    assert "Iarm → current_A" in capture.notes[0]
