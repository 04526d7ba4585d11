"""The rows of a text table: NumPy's C reader where they are plain numbers, else line by line.

The slow way either names line and column of what is wrong or, as with a text column that nobody asks for, succeeds.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import TextIO

import numpy as np

from servo_daemon.captures.capture.bounded import MAX_CELLS, check_cells
from servo_daemon.captures.capture.model import capture_error, first_bad_time, time_fault, time_mend
from servo_daemon.captures.text.dialect import COMMENTS, clock_seconds
from servo_daemon.captures.text.preamble import Preamble
from servo_daemon.config_texts import UNIT_S
from servo_daemon.errors import CaptureError
from servo_daemon.samples import F64

_POINT = "numbers need a decimal point, columns are separated by commas"


class TextTable:
    """The columns of an open text table, read when they are asked for.

    Args:
        path: for messages.
        text: seekable.
        preamble: of this text.
        likely: columns that will be asked for, index -> name: where the slow way is gone, it is gone once for all.
    """

    def __init__(self, path: Path, text: TextIO, preamble: Preamble, likely: Mapping[int, str]) -> None:
        self._path, self._text, self._preamble, self._likely = path, text, preamble, likely
        self._whole: F64 | None = None
        self._tried = False
        self._columns: dict[int, F64] = {}
        self._lines: list[int] = []
        self.told: list[str] = []

    def columns(self, wanted: Mapping[int, str]) -> dict[int, F64]:
        """Columns by index, each shape (n,), n >= 0, all finite.

        Args:
            wanted: index -> name, for messages.

        Raises:
            CaptureError: the first bad row, with line and column.
        """
        if not self._tried:
            self._tried, self._whole = True, self._read_fast()
        if self._whole is not None:
            found = {i: np.ascontiguousarray(self._whole[:, i]) for i in wanted}
            if all(np.isfinite(column).all() for column in found.values()):
                return found
        if not wanted.keys() <= self._columns.keys():
            try:
                self._columns = self._read_slowly({**self._likely, **wanted})
            except CaptureError:  # perhaps of a column that nobody asked for
                self._likely = {}
                self._columns |= self._read_slowly(wanted)
        return {i: self._columns[i] for i in wanted}

    def line(self, row: int) -> int:
        """The line of a row, both told to the user: lines from 1, rows from 0."""
        if not self._lines:
            self._read_slowly({})
        return self._lines[row]

    def check_time(self, time_s: F64) -> None:
        """Refuse the first time, shape (n,), that is not later than the one before it.

        Raises:
            CaptureError: naming both lines.
        """
        bad = first_bad_time(time_s)
        if bad is not None:
            fault = time_fault(float(time_s[bad]), float(time_s[bad - 1]))
            message = f"{fault} in line {self.line(bad - 1)}{time_mend(fault)}"
            raise capture_error(self._path, message, line=self.line(bad), column="time_s")

    def _rows(self) -> Iterator[str]:
        """The text's lines from the first row on, as they are."""
        self._text.seek(0)
        for _ in range(self._preamble.skip):
            self._text.readline()
        return iter(self._text)

    def _read_fast(self) -> F64 | None:
        """The whole table, shape (n, width), or None if anything at all is unusual (the slow way then says what)."""
        dialect, width = self._preamble.dialect, self._preamble.width
        lines = self._rows() if dialect.plain else dialect.cleaned(self._rows())
        first = next((line for line in lines if line.strip()), None)
        if first is None:
            return None
        most = MAX_CELLS // width + 1
        try:
            rows = islice(chain([first], lines), most)
            table = np.loadtxt(rows, delimiter=dialect.separator, comments=None, ndmin=2)
        except ValueError:
            return None
        check_cells(self._path, len(table), width)
        return table if table.shape[1] == width else None

    def _read_slowly(self, wanted: Mapping[int, str]) -> dict[int, F64]:
        ends = _Ends(self._rows())
        dialect = self._preamble.dialect
        reader = csv.reader(ends if dialect.plain else dialect.cleaned(ends), delimiter=dialect.separator)
        rows: list[list[float]] = []
        lines: list[int] = []
        before = self._preamble.skip  # last line of the row before
        try:
            for row in reader:
                line, before = before + 1, self._preamble.skip + reader.line_num  # a quoted cell may hold line ends
                if not row or (len(row) == 1 and not row[0].strip()) or row[0].startswith(COMMENTS):
                    continue
                try:
                    rows.append(self._numbers(row, wanted, line))
                except CaptureError:
                    if ends.complete or next(reader, None) is not None:
                        raise
                    self.told = [f"the last line, {line}, is cut off and was passed over"]
                    break
                lines.append(line)
                if len(rows) % 100_000 == 0:
                    check_cells(self._path, len(rows), self._preamble.width)
        except csv.Error as error:
            raise capture_error(self._path, f"not CSV, a quote without its end? ({error})", line=before + 1) from error
        self._lines = lines
        table = np.array(rows, dtype=np.float64).reshape(len(rows), len(wanted))
        found = {i: table[:, k].copy() for k, i in enumerate(wanted)}
        for i in self._preamble.clocks.intersection(found):  # a time of day starts anew at midnight
            found[i] += UNIT_S["d"] * np.cumsum(np.diff(found[i], prepend=found[i][:1]) < -UNIT_S["d"] / 2)
        return found

    def _numbers(self, row: Sequence[str], wanted: Mapping[int, str], line: int) -> list[float]:
        width = self._preamble.width
        if len(row) != width and not (len(row) == width + 1 and not row[-1].strip()):
            raise self._wrong_width(row, wanted, line)
        return [self._number(row[i], i, line, name) for i, name in wanted.items()]

    def _wrong_width(self, row: Sequence[str], wanted: Mapping[int, str], line: int) -> CaptureError:
        width = self._preamble.width
        message = f"{len(row)} cell{'s' if len(row) != 1 else ''}, but the header has {width} columns"
        if len(row) > width or (len(row) == 1 and ";" in row[0]):
            return capture_error(self._path, f"{message} ({_POINT})" if self._plain else message, line=line)
        missing = next((name for i, name in sorted(wanted.items()) if i >= len(row)), None)
        return capture_error(self._path, message, line=line, column=missing)

    @property
    def _plain(self) -> bool:
        return self._preamble.dialect.plain

    def _name(self, index: int) -> str | None:
        """A column's name in the header; None: there is no header."""
        return self._preamble.names[index].strip() if self._preamble.names else None

    def _number(self, cell: str, index: int, line: int, column: str) -> float:
        text = cell.strip()
        if not text:
            raise capture_error(self._path, "the cell is empty", line=line, column=column)
        if index in self._preamble.clocks and (seconds := clock_seconds(text)) is not None:
            return seconds
        shown = repr(text if len(text) <= 40 else text[:39] + "…")
        try:
            # Python's own float also takes 1_000 and the digits of every script.
            value = float(text) if text.isascii() and "_" not in text else None
        except ValueError:
            value = None
        if value is None:
            hint = f" ({_POINT})" if "," in text and self._plain else ""
            if text == self._name(index):
                hint = " but the header again: another recording begins there; mend: a file for each, all given at once"
            raise capture_error(self._path, f"{shown} is not a number{hint}", line=line, column=column)
        if not math.isfinite(value):
            raise capture_error(self._path, f"{shown} is not a finite number", line=line, column=column)
        return value


class _Ends:
    """Lines passed on, with a look at whether the last one taken had an end."""

    def __init__(self, lines: Iterable[str]) -> None:
        self._lines = iter(lines)
        self.complete = True

    def __iter__(self) -> _Ends:
        return self

    def __next__(self) -> str:
        line = next(self._lines)
        self.complete = line.endswith("\n")
        return line
