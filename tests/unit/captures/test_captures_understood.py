"""Names people use: what is certain is applied and told, what is not is asked with the flag or name that answers it."""

from __future__ import annotations

import gzip
import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import read_capture
from servo_daemon.captures.capture import bounded
from servo_daemon.captures.capture.read_options import ReadOptions, parse_supply
from servo_daemon.captures.meaning import findings
from servo_daemon.column_names import meaning
from servo_daemon.errors import BadInputError, CaptureError
from tests.field_motion import COUNTS_PER_REV, motion, table
from tests.unit.captures.test_captures_dialects import assert_the_motion

M = motion()
DEG, RPM, TURNS = np.degrees(M.x), M.w * 60 / (2 * np.pi), M.x / (2 * np.pi)
US, MS = 1e6 * M.t, 1e3 * M.t


def written(folder: Path, content: str, name: str = "log.csv") -> Path:
    path = folder / name
    path.write_text(content)
    return path


@pytest.mark.parametrize(
    ("name", "column", "scale"),
    [
        ("t_us", "time_s", 1e-6), ("millis", "time_s", 1e-3), ("ms_today", "time_s", 1e-3), ("Time", "time_s", 1.0),
        ("omega", "velocity_rad_s", 1.0), ("rpm", "velocity_rad_s", math.pi / 30),
        ("speed_rpm", "velocity_rad_s", math.pi / 30), ("vel_rad/s", "velocity_rad_s", 1.0),
        ("enc", "position_counts", 1.0), ("counts", "position_counts", 1.0), ("ticks", "position_counts", 1.0),
        ("Encoder_Counts", "position_counts", 1.0), ("enc_deg", "position_rad", math.pi / 180),
        ("position_deg", "position_rad", math.pi / 180), ("pos_estimate", "position_rad", 2 * math.pi),
        ("axis0.encoder.pos_estimate", "position_rad", 2 * math.pi), ("Iq", "current_A", 1.0),
        ("i_q_A", "current_A", 1.0), ("currentMA", "current_A", 1e-3), ("mA", "current_A", 1e-3),
        ("q_V", "voltage_V", 1.0), ("U [mV]", "voltage_V", 1e-3), ("Ankerspannung", "voltage_V", 1.0),
        ("duty", "duty", 1.0), ("pwm", "duty", 1.0), ("vbus", "supply", 1.0), ("supply_V", "supply", 1.0),
        ("position_mm", "position_m", 1e-3), ("speed_mm_s", "velocity_m_s", 1e-3),
        ("n [1/min]", "velocity_rad_s", math.pi / 30), ("rpm_filtered", "velocity_rad_s", math.pi / 30),
        ("theta_dot", "velocity_rad_s", 1.0), ("omega(t)", "velocity_rad_s", 1.0), ("u(t)", "voltage_V", 1.0),
        ("millis()", "time_s", 1e-3), ("effort_A", "current_A", 1.0), ("f [Hz]", "frequency", 2 * math.pi),
        ("speed_hz", "frequency", 2 * math.pi), ("delta_counts", "increments", 1.0), ("dEnc", "increments", 1.0),
        ("ticks_per_loop", "increments", 1.0), ("enc [counts/sample]", "increments", 1.0),
        ("delta_pos [deg]", "turned", math.pi / 180), ("counts_per_s", "count_rate", 1.0),
        ("speed [counts/s]", "count_rate", 1.0), ("rev_per_s", "velocity_rad_s", 2 * math.pi),
        ("krpm", "velocity_rad_s", 1e3 * math.pi / 30), ("X_Value", "time_s", 1.0),
    ],
)  # fmt: skip
def test_names_that_are_certain(name: str, column: str, scale: float) -> None:
    found = meaning(name)
    assert found is not None and found.certain
    assert (found.column, found.scale) == (column, pytest.approx(scale))


@pytest.mark.parametrize(
    "name", ["speed", "velocity", "position", "angle", "encoder_position", "vin", "tacho", "effort"]
)
def test_names_whose_unit_nobody_knows_are_guesses(name: str) -> None:
    found = meaning(name)
    assert found is not None and not found.certain


@pytest.mark.parametrize(
    "name",
    [
        "target_speed",
        "pos_ref",
        "d_A",
        "current_in",
        "I1",
        "dt_us",
        "sample_count",
        "temp_mos_max",
        "foo",
        "n",
        "tach (V)",
        "counts_per_rev",
        "delta_rpm",
        "sample_freq_hz",
    ],
)
def test_names_that_are_no_measurement_of_the_motor(name: str) -> None:
    assert meaning(name) is None


FULL = {
    "degrees": (table((M.t, M.v, M.i, DEG), "time_s,voltage_V,current_A,position_deg"), {}),
    "turns": (table((MS, M.v, M.i, TURNS), "millis,u_V,Iq,pos_estimate", digits=".9f"), {}),
    "angle that wraps": (table((M.t, M.v, M.i, DEG % 360), "time_s,voltage_V,current_A,angle_deg"), {}),
    "duty of a measured supply": (table((M.t, M.v / 12, 0 * M.t + 12, M.i, M.x), "t,duty,vbus,i,theta"), {}),
    "duty beside what only the values show to be the supply": (
        table((M.t, 100 * M.v / 12, 0 * M.t + 12, M.i, M.x), "t,PWM [%],vin [V],i,theta"),
        {},
    ),
    "pwm of a told supply": (
        table((M.t, M.v * 255 / 12, M.i, M.x), "t,pwm,i,theta"),
        dict(zip(("supply_V", "full_duty"), parse_supply("12/255"), strict=True)),
    ),
    "pwm of a measured supply": (
        table((M.t, M.v * 255 / (12 - M.t), 12 - M.t, M.i, M.x), "time_s,pwm,battery_V,current_A,position_rad"),
        {"supply_V": 12.0, "full_duty": 255.0},
    ),
    "counts": (table((US, M.v, M.i, M.counts), "t_us,V,A,enc", digits=".4f"), {"counts_per_rev": COUNTS_PER_REV}),
    "counts by the metadata": ("# counts_per_rev: 2400\n" + table((M.t, M.v, M.i, M.counts), "t,v,i,ticks"), {}),
    "a counter of 16 bits": (
        table((M.t, M.v, M.i, (M.counts + 32768 + 32760) % 65536 - 32768), "t,v,i,enc"),
        {"counts_per_rev": COUNTS_PER_REV},
    ),
    "counts from sample to sample": (
        table((M.t, M.v, M.i, np.diff(M.counts, prepend=0)), "time_s,voltage_V,current_A,delta_counts"),
        {"counts_per_rev": COUNTS_PER_REV},
    ),
    "degrees from sample to sample": (table((M.t, M.v, M.i, np.diff(DEG, prepend=0)), "t,v,i,delta_deg"), {}),
    "micros that wrap": (table(((US + 2**32 - 5e5) % 2**32, M.v, M.i, M.x), "t_us,v,i,theta", digits=".4f"), {}),
    "JSON lines": (
        "".join(
            json.dumps({"ms": 1e3 * t, "mV": 1e3 * v, "i": i, "pos": {"deg": d}, "mode": "run"}) + "\n"
            for t, v, i, d in zip(M.t, M.v, M.i, DEG, strict=True)
        ),
        {},
    ),
}


@pytest.mark.parametrize("name", FULL)
def test_what_is_understood_is_the_motion_and_is_told(tmp_path: Path, name: str) -> None:
    content, options = FULL[name]
    capture = read_capture(written(tmp_path, content), options=ReadOptions(**options))  # type: ignore[arg-type]
    assert_the_motion(capture)
    assert f"{len(M.t)} rows at 500.0 Hz" in capture.notes[0] and "→" in capture.notes[0]


ASKED = {
    "speed": (table((M.t, M.v, M.i, RPM), "time_s,voltage_V,current_A,speed"), "speed: its unit is not in its name"),
    "position": (table((M.t, M.v, M.i, DEG), "t,v,i,position"), "position: its unit is not in its name"),
    "a joint": (
        table((M.t, M.v, M.i, M.x, M.w), "t,v,i,position,velocity"),
        "position and velocity: their values fit rad with rad_s or deg with deg_s",
    ),
    "turns": (
        table((M.t, M.v, M.i, TURNS, RPM), "t,v,i,position,velocity", digits=".9f"),
        "their values fit turns with rpm",
    ),
    "time": (table((MS, M.v, M.i, M.x), "Time,v,i,theta"), "Time: in seconds it is no drive's time"),
    "whole numbers": (table((M.t, M.v, M.i, np.rint(DEG)), "t,v,i,theta"), "theta: whole numbers, and no unit"),
}


@pytest.mark.parametrize("name", ASKED)
def test_the_names_that_are_suggested_work(tmp_path: Path, name: str) -> None:
    content, message = ASKED[name]
    path = written(tmp_path, content)
    with pytest.raises(CaptureError) as caught:
        read_capture(path)
    text = str(caught.value)
    assert message in text and "\n" not in text
    (names,) = re.findall(r"--columns (\S+)", text)
    capture = read_capture(path, options=ReadOptions(columns=tuple(shlex.split(names)[0].split(","))))
    if name == "speed":
        assert capture.velocity_rad_s is not None
        np.testing.assert_allclose(capture.velocity_rad_s, M.w, atol=1e-3)
    elif name == "whole numbers":
        assert capture.position_rad is not None and np.abs(capture.position_rad - M.x).max() < math.radians(0.51)
    else:
        assert_the_motion(capture)


@pytest.mark.parametrize(
    ("content", "flag", "options"),
    [
        (
            table((M.t, M.v, M.i, M.counts), "time_s,voltage_V,current_A,enc"),
            "--counts-per-rev N",
            {"counts_per_rev": 1},
        ),
        (table((MS, M.v * 20, RPM), "ms,pwm,rpm"), "goes to 240: --supply 12/255", {"supply_V": 1, "full_duty": 20}),
        (table((M.t, M.v, M.i, 7 * RPM), "time_s,voltage_V,current_A,erpm"), "--pole-pairs N", {"pole_pairs": 7}),
        (
            table((M.t, M.v, M.i, np.diff(M.counts, prepend=0)), "time_s,voltage_V,current_A,delta_counts"),
            "--counts-per-rev N",
            {"counts_per_rev": 1},
        ),
        (table((M.t, M.v, M.i, 50 * RPM), "t,v,i,speed [counts/s]"), "--counts-per-rev N", {"counts_per_rev": 3000}),
        (table((M.t, M.v, M.i, 7 * RPM / 60), "t,v,i,f [Hz]"), "--pole-pairs N", {"pole_pairs": 7}),
        (
            table((M.t, M.v, M.i, M.w), "time_s,voltage_V,current_A,AI3"),
            "AI3: is it the motion?",
            {"columns": ("time_s", "voltage_V", "current_A", "AI3_rad_s")},
        ),
        (
            table((M.t, M.v, M.i, RPM, RPM), "time_s,voltage_V,current_A,left_rpm,right_rpm"),
            "which is velocity_rad_s: left_rpm or right_rpm?",
            {"columns": ("time_s", "voltage_V", "current_A", "left_rpm", "-")},
        ),
    ],
)
def test_the_only_motion_is_never_dropped_but_asked_about(
    tmp_path: Path, content: str, flag: str, options: dict[str, float]
) -> None:
    path = written(tmp_path, content)
    with pytest.raises(CaptureError) as caught:
        read_capture(path)
    assert flag in str(caught.value)
    capture = read_capture(path, options=ReadOptions(**options))  # type: ignore[arg-type]
    assert {"position_rad", "velocity_rad_s"} & set(capture.channels)
    assert "voltage_V" in capture.channels
    if "f [Hz]" in content or "AI3" in content or "counts/s" in content:
        np.testing.assert_allclose(capture.velocity_rad_s, M.w, atol=1e-3)


def test_what_beside_voltage_and_current_is_plainly_no_motion_is_left_out(tmp_path: Path) -> None:
    row = np.arange(len(M.t))
    path = written(tmp_path, table((M.t, M.v, M.i, row, row // 300), "time_s,voltage_V,current_A,row,mark"))
    assert read_capture(path).channels == ("voltage_V", "current_A")
    other = written(tmp_path, table((M.t, M.v, M.i, M.w), "time_s,voltage_V,current_A,AI3"))
    passed = ReadOptions(columns=("time_s", "voltage_V", "current_A", "-"))
    assert read_capture(other, options=passed).channels == ("voltage_V", "current_A")


def test_a_supply_without_the_full_scale_of_a_pwm_code_is_asked_about(tmp_path: Path) -> None:
    """Else a code of 241 is 2,892 V, and the mend for volts beyond reason (millivolts) is wrong by a factor of four."""
    codes = np.round(M.v / np.abs(M.v).max() * 241)
    path = written(tmp_path, table((MS, codes, RPM), "ms,pwm,rpm"))
    with pytest.raises(CaptureError, match=r"pwm is a share of the supply and goes to 241: --supply 12/255"):
        read_capture(path, options=ReadOptions(supply_V=12.0))
    capture = read_capture(path, options=ReadOptions(supply_V=12.0, full_duty=255.0))
    np.testing.assert_allclose(capture.voltage_V, codes * 12 / 255, atol=1e-6)


def test_an_angle_and_a_speed_of_which_neither_unit_is_right_are_told(tmp_path: Path) -> None:
    """As degrees and rpm, a joint in rad and rad/s has an inertia 3,283 times too large."""
    path = written(tmp_path, table((M.t, M.v, M.i, M.x, M.w), "t,v,i,position_deg,velocity_rpm"))
    (told,) = findings(read_capture(path))
    assert "is 0.1667 times as large" in told.text


def test_counts_are_never_suggested_as_radians(tmp_path: Path) -> None:
    path = written(tmp_path, table((MS, 1e3 * M.v, 1e3 * M.i, M.counts), "millis,mV,mA,enc", digits=".0f"))
    with pytest.raises(CaptureError) as caught:
        read_capture(path)
    assert 'position_counts = "enc" with counts_per_rev = N' in str(caught.value)
    assert "position_rad" not in str(caught.value)


def test_flags_beside_a_map(tmp_path: Path) -> None:
    path = written(tmp_path, table((M.v, M.i, M.counts), "a,b,c"))
    signal_map = tmp_path / "map.toml"
    signal_map.write_text('signals = { voltage_V = "a", current_A = "b", position_counts = "c" }')
    options = ReadOptions(rate_hz=500.0, counts_per_rev=COUNTS_PER_REV)
    assert_the_motion(read_capture(path, signal_map, options))
    lines = written(tmp_path, '{"t": 0, "v": 1, "i": 2}\n' * 3, "log.jsonl")
    with pytest.raises(CaptureError, match="--columns names the columns of text tables; for JSON lines use --signals"):
        read_capture(lines, options=ReadOptions(columns=("t", "v", "i")))


def test_a_unit_row_that_contradicts_a_name_is_an_error(tmp_path: Path) -> None:
    path = written(tmp_path, table((MS, M.v, M.i, M.x), "time_s,voltage_V,current_A,position_rad\nms,V,A,rad"))
    with pytest.raises(CaptureError, match="column time_s: its unit is given as ms: name it so, time_ms"):
        read_capture(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate_hz": 0.0}, "--rate must be a number greater than 0, not 0"),
        ({"counts_per_rev": 0.0}, "--counts-per-rev must be a number other than 0"),
        ({"columns": ("a",)}, "--columns needs two names"),
    ],
)
def test_flags_that_make_no_sense(options: dict[str, float], message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        ReadOptions(**options)  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match="neither volts"):
        parse_supply("12V")


@pytest.mark.parametrize("packed", [False, True])
def test_more_than_is_read_is_refused_in_words(tmp_path: Path, packed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = "".join(f"{k},1,2,3\n" for k in range(3000)).encode()
    content = b"time_s,voltage_V,current_A,position_rad\n" + rows
    path = tmp_path / "log.csv"
    path.write_bytes(gzip.compress(content) if packed else content)
    monkeypatch.setattr("servo_daemon.captures.text.rows.MAX_CELLS", 8000)
    monkeypatch.setattr(bounded.check_cells, "__defaults__", (8000,))
    with pytest.raises(CaptureError, match=r"of 4 columns: at most 8,000 numbers are read"):
        read_capture(path)
    monkeypatch.setattr(bounded, "MAX_BYTES", 20_000)
    with pytest.raises(CaptureError, match="MB of text, unpacked: cut the capture up"):
        read_capture(path)
