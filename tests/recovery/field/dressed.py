"""A file as a bench leaves it, what its user tells with it, and what the program should say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from tests.recovery.generator.native import F64


@dataclass(frozen=True, slots=True)
class Mend:
    """What the program must say of the file as it is, and what the user then does.

    Attributes:
        says: a regular expression that a message or note must hold.
        words: flags that the message asks for, with the user's values.
        put: numbers of the offered signal map that only the user knows, by key.
        expects: parameters that are determined once it is mended.
    """

    says: str
    words: tuple[str, ...] = ()
    put: Mapping[str, str] = field(default_factory=dict)
    expects: tuple[str, ...] = ("R", "K", "J", "B")


@dataclass(frozen=True, slots=True)
class Dressed:
    """One file.

    Attributes:
        motor: its name.
        name: of the file.
        text: what is in it.
        truth: values of parameters and effects' parameters.
        words: flags that its user gives.
        hidden: effects that are in it and may be named.
        expects: parameters that it must determine.
        mend: None: the file means what it says.
        told_only: numbers of the file as it is count although something is to be mended: what cannot be used is left
            out.
    """

    motor: str
    name: str
    text: bytes
    truth: Mapping[str, float]
    words: tuple[str, ...] = ()
    hidden: tuple[str, ...] = ()
    expects: tuple[str, ...] = ()
    mend: Mend | None = None
    told_only: bool = False


def table(
    columns: Mapping[str, F64],
    *,
    separator: str = ",",
    decimal: str = ".",
    digits: Mapping[str, str] | None = None,
    header: bool = True,
    above: Sequence[str] = (),
    units: Sequence[str] = (),
    tail: str = "",
    before: Sequence[str] = (),
    end: str = "\n",
) -> str:
    """A text table.

    Args:
        columns: by name.
        digits: formats of columns; else ten significant digits.
        above: lines over the header.
        units: a row below it.
        tail, before: what stands behind every row, and before each.
    """
    formats = [(digits or {}).get(name, ".10g") for name in columns]
    lines = [*above]
    if header:
        lines.append(separator.join(columns) + tail)
    if units:
        lines.append(separator.join(units) + tail)
    for k, row in enumerate(zip(*(values.tolist() for values in columns.values()), strict=True)):
        cells = separator.join(format(value, how) for value, how in zip(row, formats, strict=True))
        if decimal != ".":
            cells = cells.replace(".", decimal)
        lines.append((before[k] if before else "") + cells + tail)
    return end.join(lines) + end
