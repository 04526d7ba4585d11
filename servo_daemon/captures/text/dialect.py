"""The dialect of a text table: what separates its columns, what its decimals look like, what has to be cleaned away."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

#: What separates columns, as people call it; a blank stands for any run of blanks and tabs.
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "blanks"}
COMMENTS = ("#", "%", "//")

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)
_COMMA_NUMBER = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?|[+-]?\d{1,3}(\.\d{3})+,\d+")
#: The clock that serial monitors put before every line: "12:34:56.789 -> ", "[2024-05-01 12:34:56.789] ".
_STAMP = re.compile(r"(?:\[[^\]]*\d:\d{2}:\d{2}[^\]]*\]|\d{1,2}:\d{2}:\d{2}(?:[.,]\d+)?\s*(?:->|>|:)\s)\s*")
#: A name before a value, as the Arduino's serial plotter takes it: "mV:12".
_NAMED = re.compile(r"(?:^|(?<=[,;|\s]))([A-Za-z_][\w .\[\]()%/°-]*?)\s*[:=]\s*(?=[-+.\d])")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)")
#: A unit or a symbol with one beside it, in a header that is separated by blanks: "t [s]".
_WORD_WITH_UNIT = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?")


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a table is written.

    Attributes:
        separator: one of `SEPARATORS`.
        decimal_comma: numbers have a comma where others have a point.
        trailing: separators behind the last cell of every row.
        quoted_lines: every line is in quotes as a whole.
        stamped: every line begins with the clock of the program that received it.
        named: every value has its column's name before it.
    """

    separator: str = ","
    decimal_comma: bool = False
    trailing: int = 0
    quoted_lines: bool = False
    stamped: bool = False
    named: bool = False

    @property
    def plain(self) -> bool:
        """Nothing has to be cleaned: rows go to the reader as they are."""
        return self == OURS

    def told(self) -> list[str]:
        """In words what is not as in our own captures."""
        words = [] if self.separator == "," else [SEPARATORS[self.separator]]
        words += ["decimal commas"] if self.decimal_comma else []
        words += ["a separator at the end of every row"] if self.trailing else []
        words += ["a name before every value"] if self.named else []
        words += ["lines in quotes"] if self.quoted_lines else []
        return words + (["the receiver's clock before every line passed over"] if self.stamped else [])

    def clean(self, line: str) -> str:
        """A line as a row whose cells `separator` separates and whose decimals have points."""
        line = line.strip("\r\n \0" if self.separator == "\t" else None)
        if self.stamped:
            line = _STAMP.sub("", line, count=1)
        if self.quoted_lines and len(line) > 1 and line[0] == line[-1] == '"':
            line = line[1:-1].replace('""', '"')
        if self.named:
            line = _NAMED.sub("", line)
        for _ in range(self.trailing):
            line = line.removesuffix(self.separator)
        if self.separator == " ":
            line = " ".join(line.split())
        if self.decimal_comma:
            line = self._with_points(line)
        return line

    def _with_points(self, line: str) -> str:
        if self.separator == ",":  # then cells with a decimal comma are in quotes
            return ",".join(cell.replace(",", ".") for cell in next(csv.reader([line]), []))
        if "." not in line:
            return line.replace(",", ".")
        cells = line.split(self.separator)
        return self.separator.join(
            c.replace(".", "").replace(",", ".") if _COMMA_NUMBER.fullmatch(c.strip().strip('"')) else c for c in cells
        )

    def cleaned(self, lines: Iterable[str]) -> Iterator[str]:
        """Line by line; the numbering stays."""
        return (self.clean(line) + "\n" for line in lines)

    def cells(self, line: str) -> list[str]:
        """The cells of a line, without blanks around them."""
        row = self.clean(line)
        if not row:
            return []
        if self.separator == " ":
            return row.split(" ")
        try:
            return [cell.strip() for cell in next(csv.reader([row], delimiter=self.separator), [])]
        except csv.Error:
            return [row]

    def names(self, line: str, width: int) -> list[str] | None:
        """A header of `width` names; None: this line is none. It may be separated in another way than the rows."""
        for separator in dict.fromkeys((self.separator, "\t", ";", ",", "|", " ")):
            cells = Dialect(separator, quoted_lines=self.quoted_lines, stamped=self.stamped).cells(line)
            while len(cells) > width and not cells[-1]:
                cells = cells[:-1]
            if separator == " " and len(cells) != width:
                cells = _WORD_WITH_UNIT.findall(self.clean(line))
            if len(cells) == width:
                return cells
        return None


#: How our own captures are written.
OURS = Dialect()


def is_number(cell: str) -> bool:
    """A number with a point; "nan" is one."""
    return _NUMBER.fullmatch(cell) is not None


def is_stamped(line: str) -> bool:
    """Whether the clock of a receiver stands before a line."""
    return _STAMP.match(line.strip()) is not None


def value_names(line: str) -> list[str]:
    """The names that stand before the values of a line: "mV:12,mA:3"."""
    return [match[1].strip() for match in _NAMED.finditer(_STAMP.sub("", line, count=1))]


def is_comma_number(cell: str) -> bool:
    """A number with a decimal comma."""
    return _COMMA_NUMBER.fullmatch(cell.strip()) is not None


def clock_seconds(cell: str) -> float | None:
    """Seconds of a time of day or a date with time; None: it is neither."""
    text = cell.strip().strip('"')
    if match := _CLOCK.fullmatch(text):
        return 3600.0 * int(match[1]) + 60.0 * int(match[2]) + float(match[3].replace(",", "."))
    if len(text) < 15 or text[:4].isdigit() is False:
        return None
    try:
        return datetime.fromisoformat(text.replace(",", ".").replace("/", "-")).timestamp()
    except ValueError:
        return None


def is_value(cell: str) -> bool:
    """A number, a time of day or a date."""
    return is_number(cell) or clock_seconds(cell) is not None


def detect(lines: Sequence[str]) -> tuple[Dialect, int] | None:
    """The dialect of rows and how many columns they have; None: no table of numbers with two columns.

    Args:
        lines: from the file's beginning, without comments and blank lines; the rows are looked for in the second half.
    """
    rows = list(lines[len(lines) // 2 :])
    if not rows:
        return None
    base = Dialect(
        quoted_lines=_most(
            rows, lambda r: len(r) > 2 and r[0] == r[-1] == '"' and '"' not in r[1:-1].replace('""', "")
        ),
        stamped=_most(rows, is_stamped),
        named=_most(rows, lambda r: len(value_names(r)) > 1),
    )
    best: tuple[float, int, Dialect] | None = None
    for separator in SEPARATORS:
        found = _tried(rows, replace(base, separator=separator))
        if found is not None and (best is None or found[:2] > best[:2]):
            best = found
    if best is None:
        return None
    return best[2], best[1]


def _most(rows: Sequence[str], holds: Callable[[str], bool]) -> bool:
    return sum(holds(row.strip()) for row in rows) > 0.8 * len(rows)


#: Of the cells that must be values, and of the rows that must be equally wide, so that it is a table.
_LEAST = 0.3


def _tried(rows: Sequence[str], dialect: Dialect) -> tuple[float, int, Dialect] | None:
    """How well a separator explains the rows: share of values in equally wide rows, width; None: not at all."""
    cells = [dialect.cells(row) for row in rows]
    width = Counter(map(len, cells)).most_common(1)[0][0]
    cells = [c for c in cells if len(c) == width]
    while width > 1 and all(not c[-1] for c in cells):
        dialect, width, cells = replace(dialect, trailing=dialect.trailing + 1), width - 1, [c[:-1] for c in cells]
    if width < 2:
        return None
    commas = sum(_COMMA_NUMBER.fullmatch(c) is not None for row in cells for c in row)
    if commas:
        dialect = replace(dialect, decimal_comma=True)
        cells = [[c.replace(".", "").replace(",", ".") if _COMMA_NUMBER.fullmatch(c) else c for c in r] for r in cells]
    values = sum(is_value(c) for row in cells for c in row) / (width * len(cells))
    share = values * len(cells) / len(rows)
    return (round(share, 2), width, dialect) if share > _LEAST and values * width >= 1.5 else None


def value_columns(rows: Sequence[Sequence[str]], width: int) -> tuple[bool, ...]:
    """Which columns hold values in most of the rows."""
    whole = [row for row in rows if len(row) == width]
    return tuple(bool(whole) and sum(is_value(r[i]) for r in whole) > 0.8 * len(whole) for i in range(width))
