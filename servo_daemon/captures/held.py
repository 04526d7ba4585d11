"""What a file holds, in words, and the lines of a signal map that would make a capture of it.

The proposal goes by units and usual names. It is only ever shown: a guess that were applied would be a wrong number.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

#: Signals listed before "and n more".
_MOST = 16
_RPM = 2 * math.pi / 60

#: Unit as files spell it (lower case, no blanks) -> column of the capture and the factor to it.
_UNITS: dict[str, tuple[str, float]] = {
    "s": ("time_s", 1.0),
    "sec": ("time_s", 1.0),
    "ms": ("time_s", 1e-3),
    "us": ("time_s", 1e-6),
    "µs": ("time_s", 1e-6),
    "v": ("voltage_V", 1.0),
    "volt": ("voltage_V", 1.0),
    "mv": ("voltage_V", 1e-3),
    "a": ("current_A", 1.0),
    "ampere": ("current_A", 1.0),
    "ma": ("current_A", 1e-3),
    "rad": ("position_rad", 1.0),
    "deg": ("position_rad", math.pi / 180),
    "°": ("position_rad", math.pi / 180),
    "rev": ("position_rad", 2 * math.pi),
    "rad/s": ("velocity_rad_s", 1.0),
    "deg/s": ("velocity_rad_s", math.pi / 180),
    "°/s": ("velocity_rad_s", math.pi / 180),
    "rpm": ("velocity_rad_s", _RPM),
    "1/min": ("velocity_rad_s", _RPM),
    "min-1": ("velocity_rad_s", _RPM),
    "min^-1": ("velocity_rad_s", _RPM),
    "nm": ("torque_Nm", 1.0),
    "n·m": ("torque_Nm", 1.0),
}

#: Beginnings of names (lower case) that mean a column, the first that fits.
_NAMES: tuple[tuple[str, re.Pattern[str]], ...] = (
    ("time_s", re.compile(r"(t|tout|time|zeit|timestamps?)(_?m?s|_?sec)?$|time|zeit")),
    ("voltage_V", re.compile(r"(u|v)(_|$|in|arm|mot|a$)|volt|spannung")),
    ("current_A", re.compile(r"i(_|$|arm|mot|a$|q)|curr|strom|ampere")),
    ("velocity_rad_s", re.compile(r"(n|w)(_|$)|vel|speed|omega|rpm|drehzahl|geschw")),
    ("position_rad", re.compile(r"(q|x)(_|$)|pos|theta|phi|angle|winkel|deg|enc")),
    ("torque_Nm", re.compile(r"torq|moment|tau|tq")),
)
#: A unit at the end of a name: "U [V]", "U (V)", "t/ms".
_TAIL = re.compile(r"[\[(/]\s*([^\[\]()]+?)\s*[\])]?\s*$")

#: What a proposal asks for.
_WANTED = ("time_s", "voltage_V", "current_A", "position_rad")


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
    left = [signal for signal in held if signal.name]
    wanted = [column for column in _WANTED if not (timed and column == "time_s")]
    found: dict[str, str] = {}
    for guess in (_by_unit, _by_name):
        for signal in list(left):
            column, factor = guess(signal)
            if column == "velocity_rad_s" and "position_rad" not in found and guess is _by_unit:
                wanted = [column if w == "position_rad" else w for w in wanted]
            if column in wanted and column not in found and not signal.columns:
                scale = f", scale = {factor:.7g}" if factor != 1.0 else ""
                name = json.dumps(signal.name, ensure_ascii=False)
                found[column] = f"{{ signal = {name}{scale} }}" if scale else name
                left.remove(signal)
    matrix = next((signal for signal in left if signal.columns), None)
    for number, column in enumerate(wanted, 1):
        if column not in found:
            found[column] = (
                f"{{ signal = {json.dumps(matrix.name, ensure_ascii=False)}, column = {number} }}" if matrix else '"…"'
            )
    lines = ", ".join(f"{column} = {found[column]}" for column in wanted)
    return f"say which signal is which: --signals MAP.toml with a line such as  signals = {{ {lines} }}"


def _unit(signal: HeldSignal) -> str:
    """The unit, from the name ("U [V]", "t/ms") where the file has none beside it."""
    match = None if signal.unit else _TAIL.search(signal.name)
    return (signal.unit or (match[1] if match else "")).replace(" ", "").lower()


def _by_unit(signal: HeldSignal) -> tuple[str, float]:
    return _UNITS.get(_unit(signal), ("", 1.0))


def _by_name(signal: HeldSignal) -> tuple[str, float]:
    last = re.split(r"[.:\\]", signal.name)[-1].strip().lower()
    for column, pattern in _NAMES:
        if pattern.match(last):
            of_unit, factor = _by_unit(signal)
            return column, factor if of_unit == column else _tail_factor(last, column)
    return "", 1.0


def _tail_factor(name: str, column: str) -> float:
    """The factor that a name such as t_ms or speed_rpm tells by its ending."""
    of_unit, factor = _UNITS.get(name.rpartition("_")[2], ("", 1.0))
    return factor if of_unit == column else 1.0
