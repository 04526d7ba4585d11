"""Files of other makers under anything: a capture or one line of complaint, whatever follows the magic number."""

from __future__ import annotations

import importlib.util
import io
import os
import tempfile
import time
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from servo_daemon.captures import SignalMap, read_capture
from servo_daemon.errors import BadInputError
from tests.can_tools import RampSource, frames_of, message_of

QUICK = settings(max_examples=25, deadline=None, derandomize=True)
#: No file of a few kilobytes takes this long, s: what does goes round in circles.
ENDLESS_S = 10.0

MAGIC = {
    "mat 5": b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM",
    "mat 5, big-endian": b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI",
    "mat 4": np.array([0, 3, 1, 0, 2], "<i4").tobytes() + b"x\0",
    "mat 7.3": b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM",
    "hdf5": b"\x89HDF\r\n\x1a\n",
    "xlsx": b"PK\x03\x04",
    "xls": b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1",
    "mdf 4": b"MDF     4.10    asammdf\0",
    "mdf 3": b"MDF     3.30    asammdf\0",
    "mdf, unfinished": b"UnFinMF 4.10    asammdf\0",
    "blf": b"LOGG\x90\0\0\0",
    "asc": b"date Mon Jan 1 00:00:00 2026\nbase hex  timestamps absolute\n",
    "parquet": b"PAR1",
}
NEEDS = {"xlsx": "openpyxl", "mdf": "asammdf", "parquet": "pyarrow"}

T = np.arange(60) * 1e-3
DAMAGE = st.one_of(st.binary(min_size=1, max_size=8), st.sampled_from([bytes(8), b"\xff" * 8, b"\xff" * 4 + bytes(4)]))
OPTIONS = ("counts_per_rev", "time_base", "drive_id", "channel", "dbc")


def need(kind: str) -> None:
    library = NEEDS.get(kind.split(maxsplit=1)[0].rstrip(","))
    if library is not None and importlib.util.find_spec(library) is None:
        pytest.skip(f"{library} is not installed")


def outcome(content: bytes, signal_map: SignalMap | None = None) -> int:
    """How many samples there are; 0: it was refused, in one line that names the file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(content)
        start = time.monotonic()
        try:
            capture = read_capture(path, signal_map)
        except BadInputError as error:
            assert str(error).startswith(str(path))
            assert len(str(error).splitlines()) == 1
            return 0
        finally:
            assert time.monotonic() - start < ENDLESS_S
    for name in ("time_s", *capture.channels):
        assert np.isfinite(getattr(capture, name)).all()
    assert (np.diff(capture.time_s) > 0).all()
    return len(capture)


#: asammdf takes a tenth of a second to give up.
_SLOW = [pytest.param(kind, marks=pytest.mark.slow) if kind.startswith("mdf") else kind for kind in MAGIC]


@pytest.mark.parametrize("kind", _SLOW)
@QUICK
@given(noise=st.binary(max_size=600))
def test_garbage_after_a_magic_number(kind: str, noise: bytes) -> None:
    need(kind)
    assert outcome(MAGIC[kind] + noise) == 0


def _mat(**options: object) -> bytes:
    file = io.BytesIO()
    savemat(file, {"time_s": T, "voltage_V": T, "position_rad": T, "s": {"a": "text", "b": T}}, **options)
    return file.getvalue()


def _mdf(version: str) -> bytes:
    import asammdf

    with tempfile.TemporaryDirectory() as folder, asammdf.MDF(version=version) as file:
        signals = [asammdf.Signal(T, T, name=name) for name in ("voltage_V", "position_rad")]
        file.append(signals, common_timebase=True)
        return Path(file.save(Path(folder) / "a.mf4")).read_bytes()


def _xlsx() -> bytes:
    import openpyxl

    book, packed, plain = openpyxl.Workbook(), io.BytesIO(), io.BytesIO()
    for row in [["time_s", "voltage_V", "position_rad"], *([t, t, t] for t in T.tolist())]:
        book.active.append(row)
    book.save(packed)
    # Stored, not deflated: damage then hits XML and the archive's own tables, not only compressed data.
    with zipfile.ZipFile(packed) as source, zipfile.ZipFile(plain, "w", zipfile.ZIP_STORED) as target:
        for name in source.namelist():
            target.writestr(name, source.read(name))
    return plain.getvalue()


def _log(asc: bool, **options: int) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        writer = can.ASCWriter(str(path)) if asc else can.BLFWriter(str(path), **options)
        for frame in frames_of(RampSource(), 60):
            writer.on_message_received(message_of(frame.frame_id, frame.data, 1e9 + frame.sample * 1e-3))
        writer.stop()
        return path.read_bytes()


GOOD: dict[str, Callable[[], bytes]] = {
    "mat 5": _mat,
    "mat 5, compressed": lambda: _mat(do_compression=True),
    "mdf 4": lambda: _mdf("4.10"),
    "mdf 3": lambda: _mdf("3.30"),
    "xlsx": _xlsx,
    "blf": lambda: _log(asc=False),
    "blf, plain": lambda: _log(asc=False, compression_level=0),
    "asc": lambda: _log(asc=True),
}


@cache
def good(kind: str) -> bytes:
    return GOOD[kind]()


@pytest.mark.first_is_fast
@pytest.mark.parametrize("kind", GOOD)
@QUICK
@given(
    damage=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), DAMAGE), min_size=1, max_size=4),
    cut=st.one_of(st.none(), st.floats(0, 1)),
)
def test_damage_to_a_good_file(kind: str, damage: list[tuple[float, bytes]], cut: float | None) -> None:
    need(kind)
    content = bytearray(good(kind))
    for where, what in damage:
        at = int(where * len(content))
        content[at : at + len(what)] = what
    if cut is not None:
        content = content[: int(cut * len(content))]
    outcome(bytes(content))


@pytest.mark.parametrize("kind", GOOD)
def test_undamaged_they_are_captures(kind: str) -> None:
    need(kind)
    assert outcome(good(kind)) == len(T)


@pytest.mark.parametrize("kind", GOOD)
def test_they_may_come_through_a_pipe(kind: str, tmp_path: Path) -> None:
    need(kind)
    path, content = tmp_path / "pipe", good(kind)
    os.mkfifo(path)
    with ThreadPoolExecutor(1) as pool:
        feeding = pool.submit(path.write_bytes, content)
        assert len(read_capture(path)) == len(T)
        assert feeding.result() == len(content)


TEXT = st.text(max_size=6)
VALUE = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-3, 3), st.floats(), TEXT),
    lambda inner: st.one_of(st.lists(inner, max_size=2), st.dictionaries(TEXT, inner, max_size=2)),
    max_leaves=4,
)
ENTRY = st.one_of(
    VALUE,
    st.dictionaries(
        st.sampled_from(["signal", "formula", "scale", "offset", "wrap", "column", "row", "group", "a"]),
        st.one_of(VALUE, st.sampled_from(["voltage_V", "time_s", "a + 1", "s.b"])),
        max_size=4,
    ),
)


@pytest.mark.parametrize("kind", ["mat 5", "mdf 4", "blf"])
@QUICK
@given(
    signals=st.dictionaries(
        st.sampled_from(["time_s", "voltage_V", "current_A", "position_rad", "position_counts", "force_N", "x"]),
        ENTRY,
        max_size=4,
    ),
    options=st.dictionaries(st.sampled_from(OPTIONS), VALUE, max_size=2),
)
def test_any_map_gives_a_capture_or_one_line(kind: str, signals: dict[str, object], options: dict[str, object]) -> None:
    need(kind)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(good(kind))
        try:
            capture = read_capture(path, SignalMap(Path(folder) / "map.toml", signals, options))
        except BadInputError as error:
            assert str(error).startswith(folder)
            assert len(str(error).splitlines()) == 1
        else:
            assert len(capture) >= 2 and np.isfinite(capture.time_s).all()
