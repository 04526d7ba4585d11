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
from typing import BinaryIO, TextIO, cast

import numpy as np

from servo_daemon.captures.layout import Layout, make_layout
from servo_daemon.captures.model import MIN_SAMPLES, Capture, capture_error, first_bad_time
from servo_daemon.captures.rows import read_rows_slowly
from servo_daemon.errors import CaptureError
from servo_daemon.samples import F64

METADATA_LINE = re.compile(r"#\s*([\w.-]+)\s*:\s*(.*)")

#: A longer first line is no header: it is what a binary file looks like.
_MAX_LINE = 65536


@dataclass(frozen=True, slots=True)
class _Preamble:
    """What stands before the rows. `line` is the header's; `metadata_lines` the last line of each key."""

    metadata: Mapping[str, str]
    metadata_lines: Mapping[str, int]
    names: tuple[str, ...]
    line: int


def read_capture(path: Path | str) -> Capture:
    """A capture from CSV, gzipped CSV or Parquet; the content decides which, not the name.

    A byte order mark, CRLF, quoted cells and blank lines are accepted. Channels may be missing: time_s with a motion
    (position or speed) and an effort (voltage, current, torque or force), or with voltage and current alone (their
    dynamics still hold R, L, B/J and K²/J), is usable.

    Raises:
        CaptureError: the file cannot be read or used; one line that names file, line and column.
        BadInputError: Parquet without pyarrow installed.
    """
    path = Path(path)
    try:
        with _open(path) as raw:
            head = raw.read(4)
            raw.seek(0)
            if head == b"PAR1":
                from servo_daemon.captures.parquet import read_parquet

                return read_parquet(path, raw)
            return _read_text(path, raw, packed=head[:2] == b"\x1f\x8b")
    except CaptureError:
        raise
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise capture_error(path, f"the gzip file is cut off or damaged: {error}") from error
    except OSError as error:
        raise capture_error(path, f"cannot be read: {error.strerror or error}") from error


def _open(path: Path) -> BinaryIO:
    """The file, always seekable: a pipe is read into memory, because a bad file is read twice."""
    raw = path.open("rb")
    if raw.seekable():
        return raw
    with raw:
        return io.BytesIO(raw.read())


def _read_text(path: Path, raw: BinaryIO, *, packed: bool) -> Capture:
    binary = cast("BinaryIO", gzip.GzipFile(fileobj=raw, mode="rb")) if packed else raw
    with io.TextIOWrapper(binary, encoding="utf-8-sig", errors="replace") as text:
        preamble = _read_preamble(path, text)
        layout = make_layout(
            path,
            preamble.names,
            preamble.metadata,
            line=preamble.line,
            metadata_lines=preamble.metadata_lines,
        )
        columns = _read_rows_fast(text, layout)
        if columns is None:
            text.seek(0)
            for _ in range(preamble.line):
                text.readline()
            columns = read_rows_slowly(path, text, layout, preamble.line)
    n = columns["time_s"].shape[0]
    if n < MIN_SAMPLES:
        rows = "a header but no rows" if n == 0 else "only one sample"
        raise capture_error(path, f"{rows}: at least {MIN_SAMPLES} samples are needed", line=preamble.line + n)
    return Capture(path, axis=layout.axis, metadata=preamble.metadata, notes=layout.notes, **columns)


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
    if "time_s" in line and "," not in line:
        for separator, name in ((";", "semicolons"), ("\t", "tabs")):
            if separator in line:
                message = f"columns are separated by {name}: use commas, and a point in numbers"
                raise capture_error(path, message, line=number)
    try:
        [float(cell) for cell in re.split("[,;\t ]+", line) if cell]
    except ValueError:
        return
    hint = "; the commented line above looks like it: remove its '#'" if "time_s" in comment else ""
    raise capture_error(path, f"numbers where the header (time_s,voltage_V,…) should be{hint}", line=number)


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
    if not all(np.isfinite(column).all() for column in columns.values()):
        return None
    return columns if first_bad_time(columns["time_s"]) is None else None
