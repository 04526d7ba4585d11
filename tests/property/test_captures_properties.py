"""Properties of the capture format: exact round trips, and for any bytes a capture or one line of complaint."""

from __future__ import annotations

import gzip
import io
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from servo_daemon.captures import read_capture, write_capture
from servo_daemon.captures.text.rows import TextTable
from servo_daemon.errors import CaptureError
from servo_daemon.samples import make_block

QUICK = settings(max_examples=120, deadline=None, derandomize=True)
finite = st.floats(allow_nan=False, allow_infinity=False)

CELLS = ("0", "1.5", "-2e-3", "+7", " 3 ", "nan", "inf", "1e999", "", "x", "1_0", '"4"', '"1,5"', "٣", "0x10", "1d5")


@contextmanager
def capture_file(content: bytes) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.csv"
        path.write_bytes(content)
        yield path


def outcome(path: Path) -> str | list[list[float]]:
    """What reading gives: the numbers, or the complaint."""
    try:
        capture = read_capture(path)
    except CaptureError as error:
        return str(error)
    return [getattr(capture, name).tolist() for name in ("time_s", *capture.channels)]


@settings(QUICK, max_examples=50)
@given(
    rows=st.lists(st.tuples(finite, finite, finite), min_size=2, max_size=30, unique_by=lambda r: r[0] + 0.0),
    metadata=st.dictionaries(
        st.from_regex(r"[A-Za-z_][\w.-]{0,10}", fullmatch=True).filter(
            lambda key: key not in ("axis", "mass_kg", "arm_length_m", "counts_per_rev")
        ),
        st.text(st.characters(codec="utf-8", exclude_categories=["Cc"]), max_size=20).map(str.strip),
        max_size=3,
    ),
    suffix=st.sampled_from([".csv", ".csv.gz"]),
)
def test_round_trip_is_exact(rows: list[tuple[float, float, float]], metadata: dict[str, str], suffix: str) -> None:
    time_s, current, position = (np.array(c) for c in zip(*sorted(rows), strict=True))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write_capture(path, make_block(time_s, current_A=current, position_rad=position), metadata=metadata)
        capture = read_capture(path)
    assert dict(capture.metadata) == metadata
    for got, meant in ((capture.time_s, time_s), (capture.current_A, current), (capture.position_rad, position)):
        assert got is not None
        assert got.tobytes() == meant.tobytes()  # the sign of zero included


@QUICK
@given(st.binary(max_size=300), st.booleans(), st.sampled_from([b"", b"# a: b\n", b"time_s,voltage_V,position_rad\n"]))
@example(b"", True, b"")
@example(b"\r\r\n\n", False, b"time_s,voltage_V,position_rad\n")
def test_any_bytes_give_a_capture_or_one_line(noise: bytes, packed: bool, start: bytes) -> None:
    content = gzip.compress(start + noise) if packed else start + noise
    with capture_file(content) as path:
        result = outcome(path)
        if isinstance(result, str):
            assert result.startswith(str(path))
            assert len(result.splitlines()) == 1


@QUICK
@given(st.binary(min_size=1, max_size=8), st.integers(0, 10_000))
def test_damage_to_a_gzip_is_noticed_or_harmless(damage: bytes, where: int) -> None:
    rows = "".join(f"{k},{k * 0.1},{math.sin(k)}\n" for k in range(50))
    good = gzip.compress(f"time_s,voltage_V,position_rad\n{rows}".encode(), mtime=0)
    at = where % len(good)
    with capture_file(good[:at] + damage + good[at + len(damage) :]) as path:
        result = outcome(path)
    with capture_file(good) as path:
        assert isinstance(result, str) or result == outcome(path)


@QUICK
@given(
    st.lists(st.lists(st.sampled_from(CELLS), min_size=1, max_size=5), min_size=0, max_size=6),
    st.sampled_from(["\n", "\r\n", "\n\n"]),
)
def test_fast_and_slow_way_agree(rows: list[list[str]], ending: str) -> None:
    lines = ["time_s,voltage_V,position_rad", "-3,0,0", *(",".join(row) for row in rows)]
    with capture_file("".join(line + ending for line in lines).encode()) as path:
        usual = outcome(path)
        with mock.patch.object(TextTable, "_read_fast", return_value=None):
            assert outcome(path) == usual


@QUICK
@given(st.lists(st.sampled_from(["0.001", "0.002", "0.0035", "1"]), min_size=2, max_size=40), st.integers(1, 50))
def test_blocks_do_not_depend_on_their_size(steps: list[str], samples: int) -> None:
    time_s = np.cumsum([float(s) for s in steps])
    text = io.StringIO("time_s,current_A,position_rad\n")
    text.seek(0, io.SEEK_END)
    text.writelines(f"{t!r},0,{k}\n" for k, t in enumerate(time_s.tolist()))
    with capture_file(text.getvalue().encode()) as path:
        capture = read_capture(path)
    whole = capture.block()
    for name in ("time_s", "sequence", "quality", "current_A", "position_rad"):
        parts = [getattr(b, name) for b in capture.blocks(samples)]
        np.testing.assert_array_equal(np.concatenate(parts), getattr(whole, name))
