"""Reading captures: what kind of file it is, the lines before the rows, and the way through the rows.

The rows of a good file go through NumPy's C reader. Only if that one, or a check of its result, objects is the file
read again line by line (`rows.py`), which either names the place or, as with a text column to be ignored, succeeds.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import BinaryIO, ClassVar, TextIO, cast

import numpy as np

from servo_daemon.captures.detect import is_asc, is_mat
from servo_daemon.captures.held import HeldSignal, describe, proposal
from servo_daemon.captures.layout import METADATA_LINE, Layout, make_layout
from servo_daemon.captures.model import MIN_SAMPLES, Capture, capture_error, first_bad_time
from servo_daemon.captures.recording import Series, assemble
from servo_daemon.captures.rows import check_time, read_rows_slowly
from servo_daemon.captures.signal_map import SignalMap, SignalRef, load_signal_map
from servo_daemon.errors import CaptureError
from servo_daemon.samples import F64

#: Bytes that tell what kind of file it is: MAT's mark is the last in its header of 128.
_HEAD = 128

#: A longer first line is no header: it is what a binary file looks like.
_MAX_LINE = 65536


@dataclass(frozen=True, slots=True)
class _Preamble:
    """What stands before the rows. `line` is the header's; `metadata_lines` the last line of each key."""

    metadata: Mapping[str, str]
    metadata_lines: Mapping[str, int]
    names: tuple[str, ...]
    line: int


def read_capture(path: Path | str, signal_map: SignalMap | Path | str | None = None) -> Capture:
    """A capture from a file; its content decides what kind of file it is, not its name.

    CSV, gzipped CSV and Parquet are the project's own (docs/captures.md). MAT files, Excel workbooks, MDF and CAN logs
    (BLF, ASC) are read as well; where their signals have other names, units or time stamps of their own, the signal map
    says which is what, and `notes` what was done.

    A byte order mark, CRLF, quoted cells and blank lines are accepted in CSV. Channels may be missing: time_s with a
    motion (position or speed) and an effort (voltage, current, torque or force), or with voltage and current alone
    (their dynamics still hold R, L, B/J and K²/J), is usable.

    Args:
        path: the file; a pipe is fine.
        signal_map: which signal of the file is which column: a map or its TOML file. None: signals are named as in the
            contract.

    Raises:
        CaptureError: the file cannot be read or used; one line that names file, line (or row, sample) and column.
        ConfigError: the map is wrong.
        BadInputError: the library for this kind of file is not installed; the text names the extra.
    """
    path = Path(path)
    if isinstance(signal_map, Path | str):
        signal_map = load_signal_map(signal_map)
    try:
        with _open(path) as raw:
            head = raw.read(_HEAD)
            raw.seek(0)
            return _read_kind(path, raw, head, signal_map)
    except CaptureError:
        raise
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise capture_error(path, f"the gzip file is cut off or damaged: {error}") from error
    except OSError as error:
        raise capture_error(path, f"cannot be read: {error.strerror or error}") from error


def _read_kind(path: Path, raw: BinaryIO, head: bytes, signal_map: SignalMap | None) -> Capture:
    """What each kind of file is read by. The readers are imported here: each brings a library with it."""
    if head.startswith(b"PAR1"):
        from servo_daemon.captures.parquet import read_parquet

        return read_parquet(path, raw, signal_map)
    if head.startswith(b"PK\x03\x04"):
        from servo_daemon.captures.excel import read_excel

        return assemble(read_excel(path, raw, signal_map), signal_map)
    if head.startswith(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"):
        raise capture_error(path, "an Excel file of the old kind (.xls): save it as .xlsx")
    if head.startswith((b"MDF     ", b"UnFinMF ")):
        from servo_daemon.captures.mdf import read_mdf

        return read_mdf(path, raw, signal_map)
    if head.startswith(b"LOGG"):
        from servo_daemon.captures.can_log import read_blf
        from servo_daemon.captures.can_samples import decode_log

        return decode_log(read_blf(path, raw), signal_map)
    if is_mat(head):
        from servo_daemon.captures.mat import read_mat

        return assemble(read_mat(path, raw), signal_map)
    return _read_text(path, raw, signal_map, packed=head.startswith(b"\x1f\x8b"))


def _open(path: Path) -> BinaryIO:
    """The file, always seekable: a pipe is read into memory, because a bad file is read twice."""
    raw = path.open("rb")
    if raw.seekable():
        return raw
    with raw:
        return io.BytesIO(raw.read())


def _read_text(path: Path, raw: BinaryIO, signal_map: SignalMap | None, *, packed: bool) -> Capture:
    binary = cast("BinaryIO", gzip.GzipFile(fileobj=raw, mode="rb")) if packed else raw
    with io.TextIOWrapper(binary, encoding="utf-8-sig", errors="replace") as text:
        if is_asc(text.readline(_MAX_LINE)):
            from servo_daemon.captures.can_log import read_asc
            from servo_daemon.captures.can_samples import decode_log

            text.seek(0)
            return decode_log(read_asc(path, text), signal_map)
        text.seek(0)
        preamble = _read_preamble(path, text)
        if signal_map is not None:
            return assemble(_MappedText(path, text, preamble, signal_map), signal_map)
        layout = make_layout(
            path,
            preamble.names,
            preamble.metadata,
            line=preamble.line,
            metadata_lines=preamble.metadata_lines,
            hint=lambda: proposal([HeldSignal(name.strip()) for name in preamble.names]),
        )
        columns = _read_rows(path, text, layout, preamble)
        if first_bad_time(columns["time_s"]) is not None:
            check_time(path, columns["time_s"], _read_rows_again(path, text, layout, preamble)[1])
    n = columns["time_s"].shape[0]
    if n < MIN_SAMPLES:
        raise _too_few(path, preamble, n)
    return Capture(path, axis=layout.axis, metadata=preamble.metadata, notes=layout.notes, **columns)


def _too_few(path: Path, preamble: _Preamble, n: int) -> CaptureError:
    rows = "a header but no rows" if n == 0 else "only one sample"
    return capture_error(path, f"{rows}: at least {MIN_SAMPLES} samples are needed", line=preamble.line + n)


class _MappedText:
    """The columns of a CSV file that a signal map asks for."""

    kind: ClassVar[str] = "CSV"
    options: ClassVar[tuple[str, ...]] = ()
    timed: ClassVar[bool] = False

    def __init__(self, path: Path, text: TextIO, preamble: _Preamble, signal_map: SignalMap) -> None:
        self.path, self.metadata = path, preamble.metadata
        self._text, self._preamble = text, preamble
        names = [name.strip() for name in preamble.names]
        self.held = tuple(HeldSignal(name) for name in names)
        columns = signal_map.columns()
        needed = {operand.signal for column in columns for operand in column.operands}
        if all(column.name != "time_s" for column in columns):
            needed.add("time_s")
        used = {i: (name, name) for i, name in enumerate(names) if name in needed and names.count(name) == 1}
        self._layout = Layout(len(names), used, "rotary", ())
        self._columns = _read_rows(path, text, self._layout, preamble) if used else {}
        n = min((len(column) for column in self._columns.values()), default=MIN_SAMPLES)
        if n < MIN_SAMPLES:
            raise _too_few(path, preamble, n)

    def read(self, ref: SignalRef) -> Series:
        values = self._columns.get(ref.signal)
        if values is None or ref.label != ref.signal:
            twice = any(signal.name == ref.signal for signal in self.held) and values is None
            message = "the column is there twice" if twice else f"no such column; there are {describe(self.held)}"
            raise capture_error(self.path, message, line=self._preamble.line, column=ref.label)
        return Series(values)

    def place(self, index: int) -> str:
        return f"line {_read_rows_again(self.path, self._text, self._layout, self._preamble)[1][index]}"


def _read_preamble(path: Path, text: TextIO) -> _Preamble:
    metadata: dict[str, str] = {}
    lines: dict[str, int] = {}
    number = 0
    comment = ""
    while raw_line := text.readline(_MAX_LINE):
        number += 1
        if "\0" in raw_line or (len(raw_line) == _MAX_LINE and not raw_line.endswith("\n")):
            raise capture_error(path, "not a text file: CSV, gzipped CSV or Parquet is expected", line=number)
        line = raw_line.strip()
        if line.startswith("#"):
            comment = line
            if match := METADATA_LINE.fullmatch(line):
                key, value = match[1], match[2].strip()
                metadata[key] = f"{metadata[key]}\n{value}" if key in metadata else value
                lines[key] = number
        elif line:
            _check_header(path, line, number, comment)
            return _Preamble(metadata, lines, tuple(next(csv.reader([line]))), number)
    what = "no header, only metadata" if number else "the file is empty"
    raise capture_error(path, what, line=max(number, 1))


def _check_header(path: Path, line: str, number: int, comment: str) -> None:
    """Say what is wrong with a first row that cannot be a header, in the terms of what the user probably did."""
    if "\ufffd" in line:
        raise capture_error(path, "not a text file, or not in UTF-8", line=number)
    try:
        [float(cell) for cell in re.split("[,;\t ]+", line) if cell]
    except ValueError:
        for separator, name in ((";", "semicolons"), ("\t", "tabs")):
            if separator in line and "," not in line:
                message = f"columns are separated by {name}: use commas, and a point in numbers"
                raise capture_error(path, message, line=number) from None
        return
    hint = "; the commented line above looks like it: remove its '#'" if "time_s" in comment else ""
    raise capture_error(path, f"numbers where the header (time_s,voltage_V,…) should be{hint}", line=number)


def _read_rows(path: Path, text: TextIO, layout: Layout, preamble: _Preamble) -> dict[str, F64]:
    """The used columns by field, each shape (n,), all finite."""
    columns = _read_rows_fast(text, layout)
    return columns if columns is not None else _read_rows_again(path, text, layout, preamble)[0]


def _read_rows_again(path: Path, text: TextIO, layout: Layout, preamble: _Preamble) -> tuple[dict[str, F64], list[int]]:
    """The same from the first row on, the slow way that knows the line of each."""
    text.seek(0)
    for _ in range(preamble.line):
        text.readline()
    return read_rows_slowly(path, text, layout, preamble.line)


def _read_rows_fast(text: TextIO, layout: Layout) -> dict[str, F64] | None:
    """The used columns by field, or None if anything at all is unusual (the slow way then says what)."""
    first = next((line for line in text if line.strip()), None)
    if first is None:
        return None
    try:
        table = np.loadtxt(chain([first], text), delimiter=",", comments=None, ndmin=2)
    except ValueError:
        return None
    if table.shape[1] != layout.width:
        return None
    columns = {field: np.ascontiguousarray(table[:, i]) for i, (_, field) in layout.columns.items()}
    return columns if all(np.isfinite(column).all() for column in columns.values()) else None
