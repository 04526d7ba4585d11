"""What a file holds, in words, and the lines of a signal map that would make a capture of it.

The proposal goes by units and usual names. It is only ever shown: a guess that were applied would be a wrong number.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

from servo_daemon.column_names import Meaning, meaning

#: Signals listed before "and n more".
_MOST = 16

#: What a proposal asks for, and what may stand for it.
_WANTED: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("time_s", ()),
    ("voltage_V", ("duty",)),
    ("current_A", ()),
    ("position_rad", ("position_counts", "velocity_rad_s")),
)


@dataclass(frozen=True, slots=True)
class HeldSignal:
    """A signal in a file.

    Attributes:
        name: as the map names it.
        size: its samples, in words ("5000", "5000 × 4"); empty: not known without reading the file.
        unit: as the file has it; empty: none.
        columns: of a matrix; 0: it is none.
        plain: its name without what it is part of, where it may go by that.
    """

    name: str
    size: str = ""
    unit: str = ""
    columns: int = 0
    plain: str = ""

    @property
    def short(self) -> str:
        """The name that may be one of a capture's columns."""
        return self.plain or self.name

    @property
    def text(self) -> str:
        inside = ", ".join(part for part in (self.size, self.unit) if part)
        return f"{self.name} ({inside})" if inside else self.name or "(no name)"


def describe(held: Sequence[HeldSignal]) -> str:
    """The signals of a file in one line."""
    if not held:
        return "no numeric signal"
    more = f" and {len(held) - _MOST} more" if len(held) > _MOST else ""
    return ", ".join(signal.text for signal in held[:_MOST]) + more


def proposal(held: Sequence[HeldSignal], *, timed: bool = False) -> str:
    """How a signal map would be given, with the file's own names as far as they can be guessed.

    Args:
        held: the signals.
        timed: the signals have time stamps of their own, so that time_s is not needed.
    """
    meant = [(signal, meaning(signal.name, signal.unit)) for signal in held if signal.name]
    matrix = next((signal for signal, _ in meant if signal.columns), None)
    lines, counts = [], False
    for number, (column, others) in enumerate(_WANTED[1:] if timed else _WANTED, 1):
        best = _best([(s, m) for s, m in meant if m is not None and not s.columns], (column, *others))
        if best is None:
            open_one = f"{{ signal = {_quoted(matrix.name)}, column = {number} }}" if matrix else '"…"'
            lines.append(f"{column} = {open_one}")
            continue
        signal, what = best
        counts = counts or what.column == "position_counts"
        lines.append(_line(signal, what))
    needs = "counts_per_rev = … (of the encoder, after quadrature) and  " if counts else ""
    return (
        f"say which signal is which: --signals MAP.toml with a line such as  {needs}signals = {{ {', '.join(lines)} }}"
    )


def _best(meant: Sequence[tuple[HeldSignal, Meaning]], columns: Sequence[str]) -> tuple[HeldSignal, Meaning] | None:
    """The signal that most likely is one of these columns: what is told before what is guessed."""
    fitting = [(s, m) for s, m in meant if m.column in columns]
    return min(fitting, key=lambda c: (not c[1].certain, not c[1].told, columns.index(c[1].column)), default=None)


def _line(signal: HeldSignal, what: Meaning) -> str:
    name = _quoted(signal.name)
    if what.column == "duty":  # of a supply of 12 V, where 255 is all of it: as an Arduino's analogWrite
        return f'voltage_V = {{ formula = "12 / 255 * duty", duty = {name} }}'
    scale = f"{{ signal = {name}, scale = {what.scale:.7g} }}" if what.scale != 1.0 else name
    return f"{what.column} = {scale}"


def _quoted(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)
