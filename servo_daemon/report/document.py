"""What a report consists of: sections of texts, verdicts, equations, tables and figures, and where it all comes from.

Every string is text, never markup: the writer escapes it. Numbers may be NaN or infinite here; the writer publishes
"–" or "∞" in a text and null in data.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Literal, TypeAlias

from servo_daemon.report.figures import Bars, Figure

Tone = Literal["good", "warn", "bad", "neutral"]


@dataclass(frozen=True, slots=True)
class Text:
    """Running text; an empty line starts a new paragraph."""

    text: str


@dataclass(frozen=True, slots=True)
class Items:
    """A list of short statements; `ordered` numbers them."""

    items: tuple[str, ...]
    ordered: bool = False


@dataclass(frozen=True, slots=True)
class Code:
    """Text to be copied as it is (lines of TOML, a command), in a fixed-width font."""

    text: str
    caption: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer in a box: one headline, and the lines that support it. The tone is said by colour and in words."""

    tone: Tone
    headline: str
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Equation:
    """A displayed equation in LaTeX (the mathematics only, no `$`), with an optional line of explanation.

    What cannot be rendered as MathML is shown as its LaTeX source.
    """

    latex: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Measured:
    """A cell that is a value with its standard deviation, both in the column's unit.

    `std` infinite: the data do not determine the value. `std` None: no deviation is known, the value stands alone.
    """

    value: float | None
    std: float | None


Cell: TypeAlias = str | int | float | Measured | None


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its heading, the unit of its numbers, their significant digits; `decimals` instead aligns their
    points (correlations, say). `text` aligns the column left."""

    heading: str
    unit: str = ""
    digits: int = 4
    decimals: int | None = None
    text: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """A table; the first cell of a row names the row. `chosen` are the indices of rows to be marked, each as "◀".

    Raises:
        ValueError: a row has another number of cells than there are columns, or `chosen` names a row that is not there.
    """

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    chosen: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for k, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(f"table {self.caption!r}: row {k} has {len(row)} cells, not {len(self.columns)}")
        if any(not 0 <= k < len(self.rows) for k in self.chosen):
            raise ValueError(f"table {self.caption!r}: it has no rows {self.chosen}")


Block: TypeAlias = Text | Items | Code | Verdict | Equation | Table | Bars | Figure


@dataclass(frozen=True, slots=True)
class Section:
    """A heading and what stands under it."""

    heading: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True, slots=True)
class CaptureFile:
    """A file that went in: its name without the folder, the SHA-256 of its bytes in hexadecimal."""

    name: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Provenance:
    """How the report came about: command line, program's version, moment (with a time zone), captures.

    Raises:
        ValueError: `made` has no time zone.
    """

    command: str
    version: str
    made: datetime
    captures: tuple[CaptureFile, ...] = ()

    def __post_init__(self) -> None:
        if self.made.tzinfo is None:
            raise ValueError("made has no time zone")


@dataclass(frozen=True, slots=True)
class Report:
    """A whole document, before it is HTML."""

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    provenance: Provenance
