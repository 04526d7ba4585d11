"""The slow and exact way through the rows of a CSV capture: it knows in which line and column it is."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import numpy as np

from servo_daemon.captures.layout import Layout
from servo_daemon.captures.model import capture_error, first_bad_time, time_fault
from servo_daemon.samples import F64

_POINT = "numbers need a decimal point, columns are separated by commas"


def read_rows_slowly(path: Path, text: TextIO, layout: Layout, header_line: int) -> tuple[dict[str, F64], list[int]]:
    """The used columns by field, each shape (n,) with n >= 0, and the line of each row.

    Args:
        text: positioned after the header.
        header_line: the header's line number.

    Raises:
        CaptureError: the first bad row, with line and column.
    """
    used = [(index, name) for index, (name, _) in layout.columns.items()]
    rows: list[list[float]] = []
    lines: list[int] = []
    reader = csv.reader(text)
    before = header_line  # last line of the row before
    try:
        for row in reader:
            line, before = before + 1, header_line + reader.line_num  # a quoted cell may hold line ends
            if not row or (len(row) == 1 and not row[0].strip()):
                continue
            _check_width(path, row, layout, line)
            rows.append([_number(path, row[index], line, name) for index, name in used])
            lines.append(line)
    except csv.Error as error:
        raise capture_error(path, f"not CSV, a quote without its end? ({error})", line=before + 1) from error
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(used))
    return {layout.columns[i][1]: table[:, k].copy() for k, (i, _) in enumerate(used)}, lines


def _check_width(path: Path, row: Sequence[str], layout: Layout, line: int) -> None:
    if len(row) == layout.width:
        return
    message = f"{len(row)} cell{'s' if len(row) != 1 else ''}, but the header has {layout.width} columns"
    if len(row) > layout.width or (len(row) == 1 and ";" in row[0]):
        raise capture_error(path, f"{message} ({_POINT})", line=line)
    missing = next((name for i, (name, _) in sorted(layout.columns.items()) if i >= len(row)), None)
    raise capture_error(path, message, line=line, column=missing)


def _number(path: Path, cell: str, line: int, column: str) -> float:
    text = cell.strip()
    if not text:
        raise capture_error(path, "the cell is empty", line=line, column=column)
    shown = repr(text if len(text) <= 40 else text[:39] + "…")
    try:
        # Python's own float also takes 1_000 and the digits of every script.
        value = float(text) if text.isascii() and "_" not in text else None
    except ValueError:
        value = None
    if value is None:
        hint = f" ({_POINT})" if "," in text else ""
        raise capture_error(path, f"{shown} is not a number{hint}", line=line, column=column)
    if not math.isfinite(value):
        raise capture_error(path, f"{shown} is not a finite number", line=line, column=column)
    return value


def check_time(path: Path, time_s: F64, lines: Sequence[int]) -> None:
    """Refuse the first time, shape (n,), that is not later than the one before it.

    Raises:
        CaptureError: naming both lines.
    """
    bad = first_bad_time(time_s)
    if bad is not None:
        fault = time_fault(float(time_s[bad]), float(time_s[bad - 1]))
        raise capture_error(path, f"{fault} in line {lines[bad - 1]}", line=lines[bad], column="time_s")
