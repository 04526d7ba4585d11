"""What stands before the rows of a text table: metadata, comments, whatever a program said first, header, units."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from servo_daemon.captures.capture.bounded import MAX_LINE
from servo_daemon.captures.capture.layout import KNOWN_COLUMNS, METADATA_LINE
from servo_daemon.captures.capture.model import capture_error
from servo_daemon.captures.text.dialect import (
    COMMENTS,
    OURS,
    Dialect,
    clock_seconds,
    detect,
    is_comma_number,
    is_number,
    is_stamped,
    is_value,
    value_columns,
    value_names,
)
from servo_daemon.column_names import meaning, unit_of

#: Characters and lines from which the dialect is told.
_LOOKED_AT, _LINES = MAX_LINE, 400
#: Of the characters looked at, control characters that a binary file has more of: boot noise of a serial log has few.
_BINARY = 0.05
_STRANGE, _BEYOND_ASCII = re.compile(r"[\x00-\x08\x0b\x0e-\x1f\ufffd]"), re.compile(r"[^\x00-~]")
#: What is no UTF-8 is Windows-1252 only if its letters beyond ASCII are as few as in a European text.
_FOREIGN = 0.3


@dataclass(frozen=True, slots=True)
class Preamble:
    """What stands before the rows.

    Attributes:
        names: of the columns; empty where the file has no header.
        units: beside them, one a column; empty where there are none.
        line: the header's; without one, the last before the rows.
        skip: lines before the first row.
        width: columns of a row.
        metadata, metadata_lines: `# key: value`, and the last line of each key.
        clocks: columns that hold a time of day or a date.
        told: in words, what is not as in our own captures.
        sample: the first rows' cells, to show or to tell a program by.
    """

    names: tuple[str, ...]
    line: int
    skip: int
    width: int
    dialect: Dialect = OURS
    units: tuple[str, ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)
    metadata_lines: Mapping[str, int] = field(default_factory=dict)
    clocks: frozenset[int] = frozenset()
    told: tuple[str, ...] = ()
    sample: tuple[tuple[str, ...], ...] = ()


@dataclass(slots=True)
class _Lines:
    """The file's first lines, sorted: numbers count from 1."""

    content: list[tuple[int, str]] = field(default_factory=list)
    comments: list[tuple[int, str]] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)
    metadata_lines: dict[str, int] = field(default_factory=dict)


def read_preamble(path: Path, text: TextIO) -> Preamble:
    """What stands before the rows; `text` is left at its beginning.

    Raises:
        CaptureError: empty, no text, or no table; one line that names the place.
    """
    head = text.read(_LOOKED_AT)
    text.seek(0)
    _check_text(path, head, text.encoding)
    lines = head.splitlines()
    if len(head) == _LOOKED_AT and len(lines) > 1:
        del lines[-1]  # it may be cut off
    sorted_lines = _sorted(lines[:_LINES])
    if not sorted_lines.content:
        what = "no header, only metadata" if lines else "the file is empty"
        raise capture_error(path, what, line=max(len(lines), 1))
    return _ours(sorted_lines) or _foreign(path, sorted_lines)


def _check_text(path: Path, head: str, encoding: str) -> None:
    start = head[:4096]
    strange = len(_STRANGE.findall(start))
    foreign = len(_BEYOND_ASCII.findall(start)) if encoding == "cp1252" else 0
    if strange > _BINARY * len(start) or foreign > _FOREIGN * len(start):
        raise capture_error(path, "not a text file: CSV, gzipped CSV or Parquet is expected", line=1)
    if len(head) == _LOOKED_AT and not set("\r\n") & set(head):
        raise capture_error(path, f"not a text file: a line of more than {MAX_LINE} bytes", line=1)


def _sorted(lines: Sequence[str]) -> _Lines:
    found = _Lines()
    for number, raw in enumerate(lines, 1):
        line = raw.strip()
        if line.startswith(COMMENTS):
            found.comments.append((number, line))
            # Metadata stand before the rows: two contents are a header and a row at the least.
            if len(found.content) < 2 and (match := METADATA_LINE.fullmatch(line)):
                key, value = match[1], match[2].strip()
                found.metadata[key] = f"{found.metadata[key]}\n{value}" if key in found.metadata else value
                found.metadata_lines[key] = number
        elif line:
            found.content.append((number, raw))
    return found


def _ours(lines: _Lines) -> Preamble | None:
    """The preamble where the first content is a header of ours and its row has nothing to be cleaned; else None."""
    number, header = lines.content[0]
    names = tuple(next(csv.reader([header.strip()])))
    if not any(name.strip() in KNOWN_COLUMNS for name in names) or len(names) < 2 or is_stamped(header):
        return None
    cells = next(csv.reader([lines.content[1][1].strip()]), []) if len(lines.content) > 1 else []
    unusual = (len(cells) == len(names) + 1 and not cells[-1].strip()) or (
        len(cells) == len(names) and (_are_units(cells) or any(map(is_comma_number, cells)))
    )
    if unusual:
        return None
    return Preamble(names, number, number, len(names), metadata=lines.metadata, metadata_lines=lines.metadata_lines)


def _are_units(cells: Sequence[str]) -> bool:
    """A row of units: at least one is known, and none is a number or, as "V_motor", a name that is understood."""
    words = [cell.strip(" []()") for cell in cells]
    others = [w for w in words if w and unit_of(w) is None]
    return len(others) < len([w for w in words if w]) and not any(is_number(w) or meaning(w) for w in others)


def _foreign(path: Path, lines: _Lines) -> Preamble:
    found = detect([raw for _, raw in lines.content])
    if found is None:
        return _no_table(path, lines)
    dialect, width = found
    rows = [(number, dialect.cells(raw)) for number, raw in lines.content]
    values = value_columns([cells for _, cells in rows[len(rows) // 2 :]], width)
    first = next(
        (k for k, (_, cells) in enumerate(rows) if _is_row(cells, values)),
        None,
    )
    if first is None:
        return _no_table(path, lines)
    line, names = _names(lines, first, dialect, width)
    units = next((cells for n, cells in rows[:first] if n > line and len(cells) == width and _are_units(cells)), [])
    passed = [number for number, _ in rows[:first] if number != line and not (units and number > line)]
    told = dialect.told()
    if units:
        told.append("a row of units")
    if passed:
        told.append(f"{len(passed)} line{'s' if len(passed) > 1 else ''} before the rows passed over")
    sample = [tuple(cells) for _, cells in rows[first : first + 50] if len(cells) == width]
    clocks = frozenset(i for i in range(width) if sample and clock_seconds(sample[0][i]) is not None)
    return Preamble(
        tuple(names),
        line,
        rows[first][0] - 1,
        width,
        dialect,
        tuple(u.strip(" []()") for u in units),
        lines.metadata,
        lines.metadata_lines,
        clocks,
        tuple(told),
        tuple(sample),
    )


def _is_row(cells: Sequence[str], values: Sequence[bool]) -> bool:
    """Values in half of the columns or more in which most rows have values: one that cannot be read is a bad row."""
    if len(cells) != len(values):
        return False
    kept = [c for c, value in zip(cells, values, strict=True) if value]
    return 0 < len(kept) <= 2 * sum(map(is_value, kept))


def _names(lines: _Lines, first: int, dialect: Dialect, width: int) -> tuple[int, list[str]]:
    """The line of the header and the names of the columns, which may also stand before every value. Without any: the
    last line before the rows.

    Args:
        first: of the contents, the first row.
    """
    number, row = lines.content[first]
    if dialect.named:
        return number - 1, value_names(row)
    header = _header(lines.content[:first], dialect, width) or _commented(lines.comments, dialect, width, number)
    return header or (number - 1, [])


def _header(before: Sequence[tuple[int, str]], dialect: Dialect, width: int) -> tuple[int, list[str]] | None:
    """The last line of names before the rows: best one of which a name is understood."""
    found: tuple[int, list[str]] | None = None
    for number, raw in reversed(before):
        names = dialect.names(raw, width)
        if names is None or _are_units(names) or any(is_number(n) for n in names):
            continue
        if any(n in KNOWN_COLUMNS or meaning(n) is not None for n in names):
            return number, names
        found = found or (number, names)
    if found is None:  # names that are units only, "ms,mV,mA,counts", or like units, "t,u,n", above a row of those
        found = next(((n, c) for n, raw in before if (c := dialect.names(raw, width)) and _are_units(c)), None)
    return found


def _commented(
    comments: Sequence[tuple[int, str]], dialect: Dialect, width: int, first_row: int
) -> tuple[int, list[str]] | None:
    """A header behind a comment's mark, as numpy.savetxt and many loggers write it."""
    for number, line in reversed(comments):
        names = dialect.names(line.lstrip("#%/ "), width) if number < first_row else None
        if names and not any(is_number(n) for n in names) and any(n in KNOWN_COLUMNS or meaning(n) for n in names):
            return number, names
    return None


def _no_table(path: Path, lines: _Lines) -> Preamble:
    """A header without a row still is one; anything else is no table.

    Raises:
        CaptureError: naming the line.
    """
    number, raw = lines.content[-1]
    for separator in (",", ";", "\t", " "):
        cells = Dialect(separator).cells(raw)
        if len(cells) > 1 and len(lines.content) == 1 and not any(is_number(c) for c in cells):
            return Preamble(tuple(cells), number, number, len(cells), Dialect(separator), metadata=lines.metadata)
    shown = raw.strip()[:60]
    raise capture_error(path, f"no table: rows of two numbers or more are expected, not {shown!r}", line=number)
