"""Logs of VESC Tool, moteus tview, SimpleFOC's monitor and ODrive, made here of one motion by their columns."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.errors import CaptureError
from tests.command_line import run_command
from tests.field_motion import motion, table

M = motion()
N = len(M.t)
ZERO = np.zeros(N)
TURNS = M.x / (2 * math.pi)
PAIRS = 7


def vesc_rt(**changed: np.ndarray) -> str:
    """Columns that matter and some that do not, in the program's order; semicolons, also behind the last."""
    columns = {
        "ms_today": np.rint(43_200_000 + 1e3 * M.t),
        "input_voltage": ZERO + 24.0,
        "temp_motor": ZERO,
        "current_motor": np.abs(M.i),
        "current_in": M.i * M.v / 24.0,
        "d_axis_current": ZERO,
        "q_axis_current": M.i,
        "erpm": M.w * PAIRS * 30 / math.pi,
        "duty_cycle": M.v / 24.0,
        "tachometer": ZERO,
        "encoder_position": np.degrees(M.x) % 360.0,
        "d_axis_voltage": ZERO,
        "q_axis_voltage": M.v,
    } | changed
    return table(columns.values(), ";".join(columns) + ";", ";", tail=";")


def assert_close(capture: Capture, **wanted: np.ndarray) -> None:
    for name, values in wanted.items():
        found = getattr(capture, name)
        assert found is not None, name
        np.testing.assert_allclose(found - found[0], values - values[0], atol=2e-3)


def read(folder: Path, content: str, name: str = "log.csv", **options: object) -> Capture:
    (folder / name).write_text(content)
    return read_capture(folder / name, options=ReadOptions(**options))  # type: ignore[arg-type]


def test_vesc_real_time_log(tmp_path: Path) -> None:
    capture = read(tmp_path, vesc_rt())
    assert_close(capture, voltage_V=M.v, current_A=M.i, position_rad=M.x, time_s=M.t)
    meaning = capture.meaning()
    assert (meaning.voltage, meaning.current, meaning.convention, meaning.pole_pairs) == ("mean", "mean", "dq", 7)
    assert capture.notes[0].startswith(
        "semicolons, a separator at the end of every row, 600 rows at 500.0 Hz, VESC Tool"
    )


def test_vesc_casts_toward_zero_and_half_a_step_is_put_back(tmp_path: Path) -> None:
    """Of a gimbal motor's current a hundredth is some per cent."""
    small = 0.3 * M.i / np.abs(M.i).max()
    cut = np.trunc(100 * small) / 100
    capture = read(tmp_path, vesc_rt(q_axis_current=cut))
    block = capture.meaning().converted(capture.block())
    assert block.current_A is not None
    slope = float(small @ block.current_A / (small @ small)) / np.sqrt(1.5)
    assert abs(slope - 1.0) < 0.01 < abs(float(small @ cut / (small @ small)) - 1.0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"vesc_id": np.where(np.arange(N) < 300, 3.0, 7.0)}, r"column vesc_id: rows of several controllers \(3, 7\)"),
        (
            {"q_axis_current": np.where(np.arange(N) % 97 == 5, -21474836.48, M.i)},
            "7 rows have an average over nothing",
        ),
        ({"q_axis_voltage": np.where(np.arange(N) == 5, -2147483.648, M.v)}, "1 rows have an average over nothing"),
    ],
)
def test_vesc_rows_of_two_motors_or_of_two_readers_are_refused(
    tmp_path: Path, changed: dict[str, np.ndarray], message: str
) -> None:
    with pytest.raises(CaptureError, match=message):
        read(tmp_path, vesc_rt(**changed))
    read(tmp_path, vesc_rt(vesc_id=ZERO + 7.0))


def test_vesc_too_fast_for_its_rows_is_known_by_its_electrical_speed(tmp_path: Path) -> None:
    """Up to 0.4 turns from row to row: which way round is not known of the angle, the pole pairs are."""
    faster = 0.4 / (np.abs(np.diff(M.x)).max() / math.tau)
    turned = {"encoder_position": np.degrees(faster * M.x) % 360.0, "erpm": faster * M.w * PAIRS * 30 / math.pi}
    capture = read(tmp_path, vesc_rt(**turned))
    assert "position_rad" not in capture.channels
    assert capture.velocity_rad_s is not None
    np.testing.assert_allclose(capture.velocity_rad_s, faster * M.w, rtol=1e-3, atol=0.1)
    assert "encoder_position → " not in capture.notes[0]


def test_vesc_over_midnight(tmp_path: Path) -> None:
    late = np.rint(86_399_500 + 1e3 * M.t) % 86_400_000
    assert_close(read(tmp_path, vesc_rt(ms_today=late)), time_s=M.t, position_rad=M.x)


@pytest.mark.parametrize("angle", [ZERO, np.degrees(PAIRS * M.x / 40) % 360.0])
def test_vesc_without_an_encoder_needs_its_pole_pairs(tmp_path: Path, angle: np.ndarray) -> None:
    """Its position then stands still, or is the electrical angle: no shaft's."""
    slow = {"erpm": M.w * PAIRS / 40 * 30 / math.pi}
    content = vesc_rt(encoder_position=angle, **slow)
    with pytest.raises(CaptureError, match="erpm is the electrical speed: --pole-pairs N makes it the shaft's"):
        read(tmp_path, content)
    assert_close(read(tmp_path, content, pole_pairs=PAIRS), velocity_rad_s=M.w / 40)


def test_vesc_sampled_log_is_the_q_axis(tmp_path: Path) -> None:
    """Phases of a vector on the q axis that turns three times: Clarke and Park backwards."""
    angle = np.linspace(0.0, 6 * math.pi, N)
    columns: dict[str, np.ndarray] = {"T": 5e-5 * np.arange(N)}
    for name, size in (("I", M.i), ("V", M.v)):
        for k in range(3):
            columns[f"{name}{k + 1}"] = -size * np.sin(angle - 2 * math.pi * k / 3)
    columns |= {"I_tot": np.abs(M.i), "V_zero": ZERO + 12.0, "Phase": np.degrees(angle) % 360.0}
    capture = read(tmp_path, table(columns.values(), ";".join(columns), ";", digits=".9g", tail=";"))
    assert capture.channels == ("voltage_V", "current_A")
    assert capture.meaning().voltage == "instant"
    assert_close(capture, voltage_V=M.v, current_A=M.i)
    assert capture.sample_period_s == pytest.approx(5e-5)


STATS: Mapping[str, np.ndarray] = {
    "d_A": ZERO,
    "position": TURNS,
    "power_W": M.v * M.i,
    "q_A": M.i,
    "velocity": M.w / math.tau,
}


def test_moteus_tview_csv(tmp_path: Path) -> None:
    columns = {"timestamp": 1.7e9 + M.t, "bus_V": ZERO + 24, **STATS}
    text = table([*columns.values(), ["Mode.kPosition"] * N], ",".join(columns) + ",mode", digits=".9f")
    capture = read(tmp_path, text)
    assert_close(capture, current_A=M.i, position_rad=M.x, velocity_rad_s=M.w, time_s=M.t)
    assert "voltage_V" not in capture.channels  # bus_V is no voltage of the motor


def test_moteus_jsonl_brings_its_channels_together(tmp_path: Path) -> None:
    lines = []
    for k in range(N):
        for channel, late, data in (
            ("servo_stats", 0.0, {n: float(v[k]) for n, v in STATS.items()}),
            ("servo_control", 1e-4, {"q_V": float(M.v[k]), "i_q_A": float(M.i[k]), "torque_Nm": 0.0}),
        ):
            stamp = 1.7e9 + float(M.t[k]) + late
            lines.append(json.dumps({"controller": "1", "timestamp": stamp, "channel": channel, "data": data}))
    capture = read(tmp_path, "\n".join(lines) + "\n", "log.jsonl")
    assert {"voltage_V", "current_A", "position_rad"} <= set(capture.channels)
    assert (capture.meaning().voltage, capture.meaning().convention) == ("instant", "dq")
    assert capture.position_rad is not None
    np.testing.assert_allclose(capture.position_rad, M.x[N - len(capture) :], atol=1e-6)
    assert "JSON lines" in capture.notes[0]


@pytest.mark.parametrize(
    ("line", "message"),
    [("{", "line 3: not JSON"), ("[1, 2]", "line 3: not a JSON object with a name for every value")],
)
def test_a_bad_line_of_json_is_named(tmp_path: Path, line: str, message: str) -> None:
    rows = [json.dumps({"t": k * 1e-3, "v": 1.0, "i": 0.1 * k}) for k in range(9)]
    with pytest.raises(CaptureError, match=message):
        read(tmp_path, "\n".join([*rows[:2], line, *rows[2:]]) + "\n")


def test_simplefoc_monitor_is_dq_however_its_columns_are_told(tmp_path: Path) -> None:
    text = table((ZERO, M.v, 1e3 * M.i, M.w, M.x), None, "\t", digits=".4f")
    names = ("target", "Uq_V", "Iq_mA", "vel_rad/s", "angle_rad")
    for options in ({"rate_hz": 500.0}, {"rate_hz": 500.0, "columns": names}):
        meaning = read(tmp_path, text, "monitor.txt", **options).meaning()
        assert (meaning.voltage, meaning.current, meaning.convention) == ("instant", "instant", "dq")


def test_simplefoc_monitor_suggests_what_reads_it(tmp_path: Path) -> None:
    text = table((ZERO, M.v, 1e3 * M.i, M.w, M.x), None, "\t", digits=".4f")
    (tmp_path / "log.txt").write_text(text)
    with pytest.raises(CaptureError) as caught:
        read_capture(tmp_path / "log.txt")
    words = str(caught.value).split("monitor: ")[1].split(" (")[0].split()
    assert words[0] == "--columns" and words[2] == "--rate"
    assert float(words[3]) == pytest.approx(500.0, rel=0.02)
    for options in ({"columns": tuple(words[1].split(",")), "rate_hz": 500.0}, {"rate_hz": 500.0}):
        assert_close(
            read(tmp_path, text, **options), voltage_V=M.v, current_A=M.i, velocity_rad_s=M.w, position_rad=M.x
        )


def test_odrive_captures(tmp_path: Path) -> None:
    bulk = table((M.t, TURNS, M.i), None, digits=".18e")
    with pytest.raises(CaptureError, match=r"bulk capture .* is  --columns time_s,pos_estimate,Iq_measured"):
        read(tmp_path, bulk)
    capture = read(tmp_path, bulk, columns=("time_s", "pos_estimate", "Iq_measured"))
    assert_close(capture, current_A=M.i, position_rad=M.x)
    header = "time,axis0.motor.current_control.Iq_measured,axis0.encoder.pos_estimate"
    assert_close(read(tmp_path, table((M.t, M.i, TURNS), header)), current_A=M.i, position_rad=M.x)


def test_every_command_reads_through_the_same_flags(tmp_path: Path) -> None:
    """And what is understood is right: the motor comes out of a log with nothing of ours in it."""
    path = tmp_path / "log.csv"
    path.write_text(table((1e3 * M.t, 1e3 * M.v, 1e3 * M.i, M.counts), "millis;mV;mA;enc", ";", decimal=","))
    flags = ("--counts-per-rev", "2400", "--json")
    fit = run_command("fit", path, *flags)
    assert "semicolons, decimal commas, 600 rows at 500.0 Hz, millis → time_s" in fit.err
    found = fit.document["parameters"]
    assert found["K"]["value"] == pytest.approx(0.05, rel=0.02) and found["R"]["value"] == pytest.approx(2.0, rel=0.02)
    replay = run_command("replay", path, "--out", tmp_path / "e.csv", *flags)
    assert replay.code == 0 and "millis → time_s" in replay.err
    refused = run_command("fit", path, "--json")
    assert refused.code == 2 and "--counts-per-rev N" in refused.out + refused.err


def test_wrong_counts_a_turn_are_hinted_at(tmp_path: Path) -> None:
    path, config = tmp_path / "log.csv", tmp_path / "c.toml"
    path.write_text(table((M.t, M.v, M.i, M.counts), "t_s,u_V,i_A,enc"))
    config.write_text('[[drive]]\nname = "a"\ndriver = "simulated"\n[drive.nominal]\nK = 0.05\nJ = 5e-5\n')
    hint = "as if the counts of a turn (counts_per_rev) were told"
    for counts, told in (("9600", "4 times too large"), ("1200", "2 times too small")):
        assert f"{hint} {told}" in run_command("fit", path, "--counts-per-rev", counts, "--config", config).err
    assert hint not in run_command("fit", path, "--counts-per-rev", "2400", "--config", config).err
    config.write_text(config.read_text() + "[drive.signals]\ngear_ratio = 2\n")
    told = run_command("fit", path, "--counts-per-rev", "2400", "--config", config).err
    assert "is gear_ratio = 2 right?" in told and hint not in told
