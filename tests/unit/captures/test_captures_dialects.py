"""The same motion however a logger writes it down: one capture, and one line of what was understood."""

from __future__ import annotations

import datetime
import gzip
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.errors import CaptureError
from tests.field_motion import COUNTS_PER_REV, motion, table

M = motion()
N = len(M.t)
VIX = (M.t, M.v, M.i, M.x)
DEG, RPM = np.degrees(M.x), M.w * 60 / (2 * np.pi)
OURS = "time_s,voltage_V,current_A,position_rad"
CLOCK = [
    (datetime.datetime(2024, 5, 1, 23, 59, 59) + datetime.timedelta(seconds=float(t))).isoformat(" ", "milliseconds")
    for t in M.t
]

#: Name -> file, and a part of what is said of it.
DIALECTS: dict[str, tuple[str | bytes, str]] = {
    "semicolons, decimal commas": (
        table(VIX, "t [s];u [V];i [A];phi [rad]", ";", decimal=","),
        f"semicolons, decimal commas, {N:,} rows at 500.0 Hz, t [s] → time_s, u [V] → voltage_V",
    ),
    "semicolons, points": (table(VIX, "t [s];u [V];i [A];phi [rad]", ";"), "semicolons, 600 rows"),
    "tabs, German": (
        table((M.t, M.v, M.i, DEG), "Zeit in s\tSpannung in V\tStrom in A\tWinkel in °", "\t", decimal=","),
        "tabs, decimal commas, 600 rows at 500.0 Hz, Zeit in s → time_s",
    ),
    "blanks, percent": (table(VIX, "% t v i theta", " "), "blanks"),
    "numpy.savetxt": (table(VIX, "# time voltage current theta", " ", digits=".18e"), "blanks"),
    "fixed width": (
        "  time_s  voltage_V   current_A  position_rad\n"
        + "".join(f"{a:9.4f}{b:11.5f}{c:12.6f}{d:14.6f}\n" for a, b, c, d in zip(*VIX, strict=True)),
        "blanks",
    ),
    "bars": (table(VIX, "t | v | i | theta", " | "), "bars"),
    "Excel's first line": ("sep=;\r\n" + table(VIX, OURS.replace(",", ";"), ";", decimal=",", end="\r\n"), "1 line"),
    "preamble": ("LOG 3\nDate\t2024\n***End***\n\n" + table(VIX, OURS.replace(",", "\t"), "\t"), "3 lines before the"),
    "a sentence of as many words, and names like units": (
        "Arduino motor test v1.2\n" + table((1e3 * M.t, M.v, M.i, DEG), "ms,V_motor,I_motor,DEG"),
        "ms → time_s, V_motor → voltage_V (no unit told), I_motor → current_A (no unit told), DEG → position_rad",
    ),
    "slashes": ("// logger 1.2\n// motor: a\n" + table(VIX, OURS), ""),
    "units row": (table(VIX, OURS + "\ns,V,A,rad"), "a row of units, 600 rows at 500.0 Hz"),
    "units row under names like units": (
        table((M.t, M.v, M.i, DEG), "t\tu\ti\tphi\ns\tV\tA\tdeg", "\t"),
        "a row of units, 600 rows at 500.0 Hz, t → time_s, u → voltage_V, i → current_A, phi → position_rad",
    ),
    "units row that scales": (
        table((1e3 * M.t, M.v, M.i, DEG), "Time;Voltage;Current;Angle\n(ms);(V);(A);(deg)", ";", decimal=","),
        "a row of units, 600 rows at 500.0 Hz, Time → time_s, Voltage → voltage_V, Current → current_A, Angle → posi",
    ),
    "quoted lines": ("".join(f'"{line}"\n' for line in table(VIX, OURS).splitlines()), "lines in quotes"),
    "trailing commas": (table(VIX, OURS, tail=","), "a separator at the end of every row"),
    "trailing, in the header too": (
        table(VIX, OURS.replace(",", ";") + ";", ";", decimal=",", tail=";"),
        "a separator at the end of every row",
    ),
    "several trailing": (
        table(VIX, OURS.replace(",", ";") + ";;;", ";", decimal=",", tail=";;;"),
        "a separator at the end of every row",
    ),
    "a name before every value": (
        "".join(f"t_s:{a:.6f},V:{b:.6f},A:{c:.6f},rad:{d:.6f}\n" for a, b, c, d in zip(*VIX, strict=True)),
        "a name before every value, 600 rows at 500.0 Hz, t_s → time_s, V → voltage_V, A → current_A, rad → position",
    ),
    "a terminal's clock in brackets": (
        "".join(f"[2024-05-01 12:00:01.{k % 1000:03d}] {r}\n" for k, r in enumerate(table(VIX, OURS).splitlines())),
        "the receiver's clock before every line passed over",
    ),
    "UTF-16 with a mark": (table(VIX, OURS.replace(",", "\t"), "\t").encode("utf-16"), "UTF-16, tabs"),
    "UTF-16 without": (table(VIX, OURS.replace(",", ";"), ";", decimal=",").encode("utf-16-le"), "UTF-16, semicolons"),
    "UTF-8 with a mark": (table(VIX, "Zeit [s];U [V];I [A];φ [rad]", ";", decimal=",").encode("utf-8-sig"), "semicol"),
    "Windows-1252": (
        table((M.t, M.v, M.i, DEG), "Zeit;Spannung [V];Strom [A];Winkel [°]", ";", decimal=",").encode("cp1252"),
        "Windows-1252, semicolons, decimal commas",
    ),
    "packed": (gzip.compress(table(VIX, "t;u;i;phi", ";", decimal=",").encode(), mtime=0), "semicolons"),
    "boot noise": (
        b"\xff\x96\x80ets Jun  8 2016\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\n\0\0entry 0x4\r\n"
        + table(VIX, OURS + "\r\n0.1,12", end="\r\n").encode(),
        "4 lines before the rows passed over",
    ),
    "the receiver's clock": (
        "".join(f"12:00:01.{k % 1000:03d} -> {line}\n" for k, line in enumerate(table(VIX, OURS).splitlines())),
        "the receiver's clock before every line passed over",
    ),
    "dates": (table((CLOCK, M.v, M.i, M.x), "timestamp,voltage,current,theta"), "timestamp → time_s"),
    "time of day over midnight": (
        table(([c[11:] for c in CLOCK], M.v, M.i, M.x), "Time,voltage,current,theta"),
        "Time → time_s",
    ),
    "ms since 1970": (
        table(([f"{1.7146e12 + 1e3 * t:.0f}" for t in M.t], *VIX[1:]), "timestamp,voltage_V,current_A,theta_rad"),
        "timestamp → time_s",
    ),
    "thousands": (
        table((1e3 * M.t + 5e3, *VIX[1:]), "t_ms;u_V;i_A;phi_rad", ";", digits=",.3f")
        .replace(",", "'").replace(".", ",").replace("'", "."),
        "decimal commas",
    ),
    "comments among the rows": (table(VIX, OURS).replace("\n0.200000,", "\n# paused\n0.200000,"), ""),
    "text among the columns": (table((*VIX, ["run"] * N), "t_s,u_V,i_A,phi_rad,state"), "t_s → time_s"),
}  # fmt: skip


def assert_the_motion(capture: Capture, n: int = N) -> None:
    """The motion, time and angle counted from their beginning."""
    assert len(capture) == n
    assert capture.voltage_V is not None and capture.current_A is not None and capture.position_rad is not None
    np.testing.assert_allclose(capture.time_s - capture.time_s[0], M.t[:n], atol=1e-3)
    np.testing.assert_allclose(capture.voltage_V, M.v[:n], atol=1e-3)
    np.testing.assert_allclose(capture.current_A, M.i[:n], atol=1e-3)
    np.testing.assert_allclose(capture.position_rad - capture.position_rad[0], M.x[:n], atol=3e-3)


@pytest.mark.parametrize("name", DIALECTS)
def test_a_dialect_is_the_same_capture_and_says_what_was_understood(tmp_path: Path, name: str) -> None:
    content, told = DIALECTS[name]
    path = tmp_path / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    capture = read_capture(path)
    assert_the_motion(capture)
    assert told in "; ".join(capture.notes)


def test_a_file_of_our_own_is_not_talked_about(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(table(VIX, OURS))
    assert read_capture(path).notes == ()


@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", ",")])
def test_a_last_line_that_is_cut_off_is_passed_over_and_told(tmp_path: Path, separator: str, decimal: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(table(VIX, OURS.replace(",", separator), separator, decimal=decimal)[:-14])
    capture = read_capture(path)
    assert_the_motion(capture, N - 1)
    assert f"the last line, {N + 1}, is cut off and was passed over" in capture.notes[0]
    path.write_text(path.read_text() + "\n")  # a line that is no number but has an end is an error
    with pytest.raises(CaptureError, match=f"line {N + 1}"):
        read_capture(path)


def test_a_bad_cell_of_another_dialect_is_named_by_its_line(tmp_path: Path) -> None:
    lines = table(VIX, "t;u;i;phi", ";", decimal=",").splitlines()
    lines[100] = lines[100].replace(";", ";x", 1)
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(CaptureError, match=r"line 101, column u: 'x.*' is not a number"):
        read_capture(path)


def test_a_second_recording_in_the_same_file_is_named_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(2 * table(VIX, "t_s;V;A;phi_rad", ";", decimal=","))
    with pytest.raises(CaptureError, match=rf"line {N + 2}, column t_s: .* header again: .* mend: a file for each"):
        read_capture(path)


@pytest.mark.parametrize(
    ("header", "options"),
    [
        (None, ReadOptions(columns=("time_s", "V", "A", "rad"))),
        (OURS, ReadOptions(columns=("time_s", "u_V", "i_A", "phi_rad"))),
        ("a,b,c,d", ReadOptions(columns=("-", "voltage", "current", "theta"), rate_hz=500.0)),
    ],
)
def test_names_and_rate_are_told_where_the_file_has_none(
    tmp_path: Path, header: str | None, options: ReadOptions
) -> None:
    path = tmp_path / "log.csv"
    path.write_text(table(VIX, header))
    capture = read_capture(path, options=options)
    assert_the_motion(capture)
    assert f"{N} rows at 500.0 Hz" in capture.notes[0]


def test_a_table_without_a_header_asks_for_its_names(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(table(VIX, None))
    with pytest.raises(CaptureError, match=r"line 1: numbers where the header .* --columns time_ms,voltage_V,mA,rpm$"):
        read_capture(path)
    with pytest.raises(CaptureError, match=r"--columns names 3 columns, but the rows have 4: 0\.000000,"):
        read_capture(path, options=ReadOptions(columns=("time_s", "V", "A")))


def test_a_table_with_neither_header_nor_time_asks_for_both(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(table((M.v, M.i, M.x), None))
    with pytest.raises(CaptureError, match=r"name the 3 columns .*; where none is a time, also --rate HZ"):
        read_capture(path)


def test_a_table_without_a_time_asks_for_its_rate(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(table(VIX[1:], "voltage_V,current_A,position_rad"))
    with pytest.raises(CaptureError, match=r"no column time_s; .*--rate HZ says"):
        read_capture(path)
    assert_the_motion(read_capture(path, options=ReadOptions(rate_hz=500.0)))


def test_counts_of_a_logger_with_boot_noise(tmp_path: Path) -> None:
    rows = table((1e6 * M.t, 1e3 * M.v, 1e3 * M.i, M.counts), "t_us,mV,mA,counts", digits=".0f", end="\r\n")
    path = tmp_path / "log.txt"
    path.write_text("ets Jun  8 2016\r\n" + rows)
    capture = read_capture(path, options=ReadOptions(counts_per_rev=COUNTS_PER_REV))
    assert_the_motion(capture)
    assert capture.counts_per_rev == COUNTS_PER_REV
