"""Excel workbooks (.xlsx) by openpyxl: one sheet with a header row, as a CSV would be.

Lines `# key: value` above the header are metadata, a row of units below it is understood, empty rows are passed over.
"""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from servo_daemon.captures.capture.bounded import MAX_BYTES, MAX_OBJECTS, check_cells
from servo_daemon.captures.capture.layout import KNOWN_COLUMNS, METADATA_LINE
from servo_daemon.captures.capture.model import MIN_SAMPLES, capture_error
from servo_daemon.captures.columns.foreign import Series
from servo_daemon.captures.columns.held import HeldSignal, describe, proposal
from servo_daemon.captures.columns.recording import parser_failed
from servo_daemon.captures.columns.signal_map import SignalMap, SignalRef
from servo_daemon.column_names import meaning
from servo_daemon.errors import CaptureError
from servo_daemon.extras import require

#: Rows among which the header is looked for.
_HEADER_WITHIN = 200


@dataclass(frozen=True, slots=True)
class _Sheet:
    """A sheet's cells from its header on; `rows` holds the row numbers (1-based) of `cells`."""

    name: str
    header: tuple[str, ...]
    units: tuple[str, ...]
    metadata: Mapping[str, str]
    rows: Sequence[int]
    cells: Sequence[tuple[Any, ...]]


@dataclass(frozen=True, slots=True)
class SheetRecording:
    """One sheet of a workbook."""

    kind: ClassVar[str] = "Excel sheets"
    options: ClassVar[tuple[str, ...]] = ("sheet",)
    timed: ClassVar[bool] = False
    header_line: ClassVar[int | None] = None
    told: ClassVar[tuple[str, ...]] = ()

    path: Path
    sheet: _Sheet

    @property
    def metadata(self) -> Mapping[str, str]:
        return self.sheet.metadata

    @property
    def held(self) -> tuple[HeldSignal, ...]:
        return _held(self.sheet)

    def read(self, ref: SignalRef) -> Series:
        if ref.column is not None or ref.row is not None or ref.group is not None:
            raise capture_error(self.path, "a sheet's columns have no 'column', 'row' or 'group'", column=ref.label)
        found = [i for i, name in enumerate(self.sheet.header) if name == ref.signal]
        where = f"sheet {self.sheet.name}"
        if len(found) != 1:
            message = "the column is there twice" if found else f"no such column; there are {describe(self.held)}"
            raise capture_error(self.path, message, place=where, column=ref.label)
        index = found[0]
        values = [self._number(row, cells, index, ref.label) for row, cells in self._numbered()]
        if len(values) < MIN_SAMPLES:
            rows = "a header but no rows" if not values else "only one sample"
            raise capture_error(self.path, f"{rows}: at least {MIN_SAMPLES} samples are needed", place=where)
        return Series(np.array(values, dtype=np.float64))

    def place(self, index: int) -> str:
        return f"sheet {self.sheet.name}, row {self.sheet.rows[index]}"

    def _numbered(self) -> zip[tuple[int, tuple[Any, ...]]]:
        return zip(self.sheet.rows, self.sheet.cells, strict=True)

    def _number(self, row: int, cells: tuple[Any, ...], index: int, label: str) -> float:
        cell = cells[index] if index < len(cells) else None
        if isinstance(cell, int | float) and not isinstance(cell, bool):
            return float(cell)
        if cell is None:
            message = "the cell is empty (or a formula whose result was never saved)"
        elif isinstance(cell, str):
            message = f"{cell[:40]!r} is text, not a number"
        else:
            message = f"{str(cell)[:40]!r} is a {type(cell).__name__}, not a number"
        raise capture_error(self.path, message, place=f"sheet {self.sheet.name}, row {row}", column=label)


def read_excel(path: Path, raw: BinaryIO, signal_map: SignalMap | None) -> SheetRecording:
    """The sheet that is meant: the map's `sheet`, else the only one whose header has what is needed.

    Raises:
        CaptureError: damaged, no such sheet, or no (or more than one) sheet that fits.
        BadInputError: openpyxl is not installed.
    """
    openpyxl = require("openpyxl", "openpyxl", "excel", f"{path}: Excel", "use CSV")
    wanted = signal_map.text("sheet") if signal_map is not None else None
    try:
        _check_unpacked(path, raw)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # styles and validations that openpyxl does not know
            book = openpyxl.load_workbook(raw, read_only=True, data_only=True)
            names = [sheet.title for sheet in book.worksheets]
            sheets = [_sheet(path, s) for s in book.worksheets if wanted is None or s.title == wanted]
            book.close()
    except CaptureError:
        raise
    except Exception as error:  # zip, XML and openpyxl's own parsers raise whatever they stumble over
        raise parser_failed(path, "Excel workbook (.xlsx)", error) from error
    if wanted is not None and not sheets:
        raise capture_error(path, f"no sheet {wanted!r}: there are {', '.join(names)}")
    if signal_map is None:
        sheets_that_fit = [s for s in sheets if _makes_a_capture(_held(s))]
    else:
        needed = {operand.signal for column in signal_map.columns() for operand in column.operands}
        sheets_that_fit = [s for s in sheets if needed <= set(s.header)]
    if len(sheets_that_fit) > 1:
        fitting = ", ".join(s.name for s in sheets_that_fit)
        raise capture_error(path, f'more than one sheet fits: {fitting}; name one in a map: sheet = "…"')
    if not sheets_that_fit and len(sheets) > 1:
        found = "; ".join(f"sheet {s.name}: {describe(_held(s))}" for s in sheets if s.header)
        held = [signal for sheet in sheets for signal in _held(sheet)]
        todo = f"; {proposal(held)}" if signal_map is None and held else ""
        raise capture_error(path, f"no sheet has the columns needed: {found or 'all are empty'}{todo}")
    if not sheets:
        raise capture_error(path, "the workbook has no sheet with cells")
    return SheetRecording(path, (sheets_that_fit or sheets)[0])


def _makes_a_capture(held: Sequence[HeldSignal]) -> bool:
    """Whether a sheet has a time beside something else by its columns' names."""
    columns = {
        s.name if s.name in KNOWN_COLUMNS else m.column for s in held if (m := meaning(s.name, s.unit)) is not None
    }
    return "time_s" in columns and len(columns) > 1


def _check_unpacked(path: Path, raw: BinaryIO) -> None:
    """A workbook is a zip file: its parts say how large they are unpacked, and zipfile lets none be larger."""
    with zipfile.ZipFile(raw) as parts:
        size = sum(part.file_size for part in parts.infolist())
    raw.seek(0)
    if size > MAX_BYTES:
        raise capture_error(
            path, f"{size >> 20} MB unpacked: at most {MAX_BYTES >> 20} MB are read; cut the capture up"
        )


def _sheet(path: Path, sheet: Any) -> _Sheet:
    """Cells of an openpyxl worksheet from its header on."""
    metadata: dict[str, str] = {}
    header: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    rows: list[int] = []
    cells: list[tuple[Any, ...]] = []
    for number, row in enumerate(sheet.iter_rows(values_only=True), 1):
        if all(cell is None for cell in row):
            continue
        if header:
            if not rows and not units and all(_is_word(cell) for cell in row if cell is not None):
                units = tuple(str(cell or "").strip(" []()") for cell in row)
                continue
            rows.append(number)
            cells.append(row)
            check_cells(path, len(rows), len(row), MAX_OBJECTS)
        elif isinstance(row[0], str) and row[0].lstrip().startswith("#"):
            if match := METADATA_LINE.fullmatch(row[0].strip()):
                key, value = match[1], match[2].strip()
                metadata[key] = f"{metadata[key]}\n{value}" if key in metadata else value
        elif sum(isinstance(cell, str) for cell in row) > 1:
            header = tuple("" if cell is None else str(cell).strip() for cell in row)
        elif number > _HEADER_WITHIN:
            break
    while header and not header[-1]:
        header = header[:-1]
    return _Sheet(sheet.title, header, units, metadata, rows, cells)


def _is_word(cell: Any) -> bool:
    """A text that is not meant as a number."""
    if not isinstance(cell, str):
        return False
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return True
    return False


def _held(sheet: _Sheet) -> tuple[HeldSignal, ...]:
    n = str(len(sheet.rows))
    return tuple(
        HeldSignal(name, n, sheet.units[i] if i < len(sheet.units) else "")
        for i, name in enumerate(sheet.header)
        if name
    )
