"""Reading captures: what is accepted, and the one line that says what is not."""

from __future__ import annotations

import gzip
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import read_capture
from servo_daemon.errors import CaptureError
from servo_daemon.samples import Quality

FULL = "time_s,voltage_V,current_A,position_rad\n"
ROWS = "0.0,1.0,0.5,0.0\n0.001,1.5,0.6,0.01\n0.002,2.0,0.7,0.02\n"


def gz(text: str) -> bytes:
    """Without the time of day, which would give these tests another name with every second."""
    return gzip.compress(text.encode(), mtime=0)


def written(folder: Path, content: str | bytes, name: str = "a.csv") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_full_capture(tmp_path: Path) -> None:
    path = written(tmp_path, "# mass_kg: 0.49\n# arm_length_m: 0.1\n# note: a: b, c\n# free words\n\n" + FULL + ROWS)
    capture = read_capture(path)
    assert capture.channels == ("voltage_V", "current_A", "position_rad")
    assert capture.time_s.tolist() == [0.0, 0.001, 0.002]
    assert capture.position_rad is not None and capture.position_rad.tolist() == [0.0, 0.01, 0.02]
    assert dict(capture.metadata) == {"mass_kg": "0.49", "arm_length_m": "0.1", "note": "a: b, c"}
    assert (capture.mass_kg, capture.arm_length_m, capture.counts_per_rev) == (0.49, 0.1, None)
    assert (capture.axis, capture.notes, len(capture)) == ("rotary", (), 3)
    assert capture.sample_period_s == pytest.approx(0.001)
    assert capture.duration_s == 0.002
    with pytest.raises(ValueError, match="read-only"):
        capture.position_rad[0] = 1.0


@pytest.mark.parametrize(
    ("header", "channels", "axis"),
    [
        ("time_s,current_A,position_rad", ("current_A", "position_rad"), "rotary"),
        ("time_s,voltage_V,position_rad", ("voltage_V", "position_rad"), "rotary"),
        ("time_s,voltage_V,velocity_rad_s", ("voltage_V", "velocity_rad_s"), "rotary"),
        ("time_s,current_A,velocity_rad_s", ("current_A", "velocity_rad_s"), "rotary"),
        ("time_s,torque_Nm,position_rad", ("position_rad", "torque_Nm"), "rotary"),
        ("velocity_rad_s,torque_Nm,time_s", ("velocity_rad_s", "torque_Nm"), "rotary"),
        ("time_s,force_N,position_m", ("position_rad", "torque_Nm"), "linear"),
        ("time_s,force_N,velocity_m_s", ("velocity_rad_s", "torque_Nm"), "linear"),
        ("time_s,voltage_V,position_m", ("voltage_V", "position_rad"), "linear"),
        ("time_s,voltage_V,current_A", ("voltage_V", "current_A"), "rotary"),
    ],
)
def test_usable_column_sets(tmp_path: Path, header: str, channels: tuple[str, ...], axis: str) -> None:
    capture = read_capture(written(tmp_path, f"{header}\n0,0,1\n1,1,2\n"))
    assert (capture.channels, capture.axis) == (channels, axis)


def test_metadata_decide_the_axis_where_no_column_does(tmp_path: Path) -> None:
    text = "# axis: linear\ntime_s,voltage_V,current_A\n0,0,1\n1,1,2\n"
    assert read_capture(written(tmp_path, text)).axis == "linear"


def test_repeated_metadata_are_joined(tmp_path: Path) -> None:
    text = "# note: one\n# note: two\n" + FULL + ROWS
    assert read_capture(written(tmp_path, text)).metadata["note"] == "one\ntwo"


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbf" + (FULL + ROWS).encode(),
        b"\xef\xbb\xbf# note: x\n" + (FULL + ROWS).encode(),
        (FULL + ROWS).replace("\n", "\r\n").encode(),
        (FULL + ROWS).replace("\n", "\r").encode(),
        (FULL + ROWS).rstrip("\n").encode(),
        (FULL + ROWS).replace(",", " , ").encode(),
        (FULL + "\n" + ROWS.replace("\n", "\n\n") + "  \n").encode(),
        (FULL.replace("time_s", '"time_s"') + ROWS.replace("0.5", '"0.5"')).encode(),
        b"\xef\xbb\xbf" + (FULL + ROWS.replace("0.5", '"0.5"')).encode(),
        gz(FULL + ROWS),
        gz(FULL) + gz(ROWS),
        b"# note: 3 \xd9 in latin-1\n" + (FULL + ROWS).encode(),
    ],
)
def test_every_spelling_of_the_same_capture(tmp_path: Path, content: bytes) -> None:
    capture = read_capture(written(tmp_path, content))
    assert capture.voltage_V is not None and capture.voltage_V.tolist() == [1.0, 1.5, 2.0]
    assert capture.current_A is not None and capture.current_A.tolist() == [0.5, 0.6, 0.7]
    assert capture.time_s.tolist() == [0.0, 0.001, 0.002]


@pytest.mark.parametrize("word", ["9", "nan", "", "braking, hard"])
def test_unknown_columns_are_ignored_with_a_note_whatever_they_hold(tmp_path: Path, word: str) -> None:
    text = f'time_s,mode,voltage_V,position_rad,\n0,"{word}",1,0,\n1,"{word}",2,3,\n'
    capture = read_capture(written(tmp_path, text))
    assert capture.notes == ("unknown columns ignored: mode, number 5 (no name)",)
    assert capture.position_rad is not None and capture.position_rad.tolist() == [0.0, 3.0]


def test_seconds_since_1970_keep_what_a_double_holds(tmp_path: Path) -> None:
    times = [f"17000000{k // 1000:02d}.{k % 1000:03d}125" for k in range(2000)]
    text = "time_s,voltage_V,position_rad\n" + "".join(f"{t},1,{k}\n" for k, t in enumerate(times))
    capture = read_capture(written(tmp_path, text))
    assert capture.time_s.tolist() == [float(t) for t in times]
    # 0.24 µs: the distance of two doubles there; it does not add up over the capture.
    assert np.abs(np.diff(capture.time_s) - 1e-3).max() < 2.5e-7
    assert capture.duration_s == pytest.approx(1.999, abs=2.5e-7)
    assert not capture.quality().any()


def test_gaps_are_flagged_and_jitter_is_not(tmp_path: Path) -> None:
    time_s = [0.0, 0.0012, 0.002, 0.0034, 0.004, 0.005, 0.007, 0.008, 0.009, 1.0]
    text = "time_s,voltage_V,position_rad\n" + "".join(f"{t},1,1\n" for t in time_s)
    capture = read_capture(written(tmp_path, text))
    flagged = np.flatnonzero(capture.quality() & Quality.GAP_BEFORE)
    assert flagged.tolist() == [6, 9]


@pytest.mark.parametrize("samples", [1, 7, 64, 10_000])
def test_blocks_are_the_capture_cut_up(tmp_path: Path, samples: int) -> None:
    text = FULL + "".join(f"{k * 1e-3 + (k > 50)},{k},{-k},{k / 7}\n" for k in range(100))
    capture = read_capture(written(tmp_path, text))
    whole, parts = capture.block(), list(capture.blocks(samples))
    assert sum(len(b) for b in parts) == 100
    for name in ("time_s", "sequence", "quality", *capture.channels):
        np.testing.assert_array_equal(np.concatenate([getattr(b, name) for b in parts]), getattr(whole, name))
    assert int(whole.quality[51]) == Quality.GAP_BEFORE
    with pytest.raises(ValueError, match="at least one sample"):
        next(capture.blocks(0))


BAD = {
    "empty": ("", "line 1: the file is empty"),
    "only metadata": ("# a: b\n# c: d\n", "line 2: no header, only metadata"),
    "only header": ("# a: b\n" + FULL, "line 2: a header but no rows: at least 2 samples are needed"),
    "one row": (FULL + "0,1,2,3\n", "line 2: only one sample: at least 2 samples are needed"),
    "no header": (ROWS, "line 1: numbers where the header (time_s,voltage_V,…) should be"),
    "savetxt header": (
        "# time_s,voltage_V\n" + ROWS,
        "line 2: numbers where the header (time_s,voltage_V,…) should be: 0.0,1.0,0.5,0.0; name the 4 columns in "
        "their order, with units, as in  --columns time_ms,voltage_V,mA,rpm",
    ),
    "no time": (
        "s,voltage_V,position_rad\n0,1,2\n1,1,2\n",
        "line 1, column time_s: no column time_s; the file holds s, voltage_V, position_rad; where there is none, -",
    ),
    "no usable set": (
        "# a: b\ntime_s,position_rad,velocity_rad_s\n0,1,2\n",
        "line 2: no usable set of columns"
        "; the file holds time_s, position_rad, velocity_rad_s; say which signal is which: --signals MAP.toml",
    ),
    "duplicate": (
        "time_s,voltage_V,position_rad, voltage_V\n0,1,2,3\n",
        "line 1, column voltage_V: the column is there twice",
    ),
    "both axes": (
        "time_s,force_N,position_rad\n0,1,2\n1,1,2\n",
        "line 1: mixes the linear axis's force_N with the rotary position_rad",
    ),
    "axis contradicts": (
        "# axis: linear\n" + FULL + ROWS,
        "line 1: metadata axis: linear does not fit the column position_rad",
    ),
    "axis unknown": ("# axis: diagonal\n" + FULL + ROWS, "line 1: metadata axis: 'diagonal' is neither"),
    "mass": ("# a: b\n# mass_kg: heavy\n" + FULL + ROWS, "line 2: metadata mass_kg: 'heavy' is not a number greater"),
    "negative counts": ("# counts_per_rev: -1\n" + FULL + ROWS, "line 1: metadata counts_per_rev: '-1' is not"),
    "text": (FULL + ROWS + "0.003,abc,1,2\n", "line 5, column voltage_V: 'abc' is not a number"),
    "underscore": (FULL + ROWS + "0.003,1_0,1,2\n", "line 5, column voltage_V: '1_0' is not a number"),
    "long text": (FULL + ROWS + f"0.003,{'x' * 90},1,2\n", f"column voltage_V: '{'x' * 39}…' is not a number"),
    "blank lines count": ("# a: b\n\n" + FULL + "\n" + ROWS + "\n0.003,1,oops,2\n", "line 9, column current_A: 'oops'"),
    "nan": (FULL + ROWS + "0.003,1,nan,2\n", "line 5, column current_A: 'nan' is not a finite number"),
    "inf": (FULL + ROWS + "0.003,1,1,-inf\n", "line 5, column position_rad: '-inf' is not a finite number"),
    "too large": (FULL + ROWS + "0.003,1,1,1e999\n", "line 5, column position_rad: '1e999' is not a finite number"),
    "empty cell": (FULL + ROWS + "0.003,,1,1\n", "line 5, column voltage_V: the cell is empty"),
    "short row": (FULL + ROWS + "0.003,1\n", "line 5, column current_A: 2 cells, but the header has 4 columns"),
    "all rows short": ("time_s,voltage_V,position_rad\n0,1\n1,2\n", "line 2, column position_rad: 2 cells, but the"),
    "long row": (FULL + ROWS + "0.003,1,1,1,1\n", "line 5: 5 cells, but the header has 4 columns (numbers need"),
    "decimal commas": (
        FULL + "0,0,1,5,0,3,0,1\n",
        "line 2: 8 cells, but the header has 4 columns (numbers need a decimal point",
    ),
    "late decimal comma": (FULL + ROWS + '0,"1,5",0,0\n', "line 5, column voltage_V: '1,5' is not a number (numbers"),
    "semicolons": (FULL.replace(",", ";") + "0;1;x;3\n1;1;2;3\n2;1;2;3\n", "line 2, column current_A: 'x' is not a"),
    "semicolons below": (FULL + "0;1;2;3\n", "line 2: 1 cell, but the header has 4 columns (numbers need a decimal"),
    "time repeated": (
        "# a: b\n" + FULL + ROWS + "0.002,1,1,1\n",
        "line 6, column time_s: time is repeated: 0.002 after 0.002 in line 5; mend: --rate HZ",
    ),
    "time back": (
        FULL + ROWS + "\n0.0005,1,1,1\n",
        "line 6, column time_s: time jumps back: 0.0005 after 0.002 in line 4; mend: cut the file",
    ),
    "quote never closed": (FULL + '0,"1,2,3\n' + "1,2,3,4\n" * 30_000, "line 2: not CSV, a quote without its end? ("),
    "quote closed too late": (FULL + '0,"1,2,3\n1,"2,3,4\n', "line 2, column voltage_V: '1,2,3\\n1,2' is not a number"),
}


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("packed", [False, True], ids=["plain", "gzip"])
def test_bad_capture_is_one_line_naming_the_place(tmp_path: Path, name: str, packed: bool) -> None:
    content, message = BAD[name]
    path = written(tmp_path, gz(content) if packed else content, "bad capture.csv")
    with pytest.raises(CaptureError) as caught:
        read_capture(path)
    text = str(caught.value)
    assert text.startswith(f"{path}, ")
    assert message in text
    assert "\n" not in text
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (gz(FULL + ROWS * 2000)[:-20], "the gzip file is cut off or damaged"),
        (gz(FULL + ROWS)[:14], "the gzip file is cut off or damaged"),
        (gz(FULL + ROWS)[:-8] + bytes(8), "the gzip file is cut off or damaged"),
        (bytes(range(256)) * 40, "line 1: not a text file"),
        (b"PK\x03\x04" + bytes(100), "not a usable Excel workbook (.xlsx), or cut off: File is not a zip file"),
        (b"\x89PNG\xff\xfe\xfd,\xfc", "line 1: not a text file"),
        (b"x" * 200_000, "line 1: not a text file: a line of more than 65536 bytes"),
        (FULL.encode() + b"1" * 200_000, "not a text file: a line of more than 65536 bytes"),
        (gz(FULL + ROWS + "1" * 2_000_000), "not a text file: a line of more than 65536 bytes"),
    ],
)
def test_damaged_or_foreign_files(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(CaptureError) as caught:
        read_capture(written(tmp_path, content))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"nowhere\.csv: cannot be read: No such file or directory"):
        read_capture(tmp_path / "nowhere.csv")
    with pytest.raises(CaptureError, match="cannot be read: Is a directory"):
        read_capture(tmp_path)


def test_a_pipe_can_be_read_even_the_slow_way(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    content = (FULL + ROWS).replace("0.5", '"0.5"').encode()
    with ThreadPoolExecutor(1) as pool:
        feeding = pool.submit(path.write_bytes, content)
        capture = read_capture(path)
        assert feeding.result() == len(content)
    assert len(capture) == 3


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, *args: object, **kwargs: object) -> None:
        raise PermissionError(13, "Permission denied")

    path = written(tmp_path, FULL + ROWS)
    monkeypatch.setattr(Path, "open", refuse)  # tests may run as root, whom no mode bits stop
    with pytest.raises(CaptureError, match=r"a\.csv: cannot be read: Permission denied"):
        read_capture(path)
