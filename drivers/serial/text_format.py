"""What a line of the text wire holds: `t_us,mV,mA,counts`, or the columns that a header line, the options or
`name:value` pairs name. Names are understood as those of captures are (`servo_daemon/column_names.py`)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from servo_daemon.column_names import Meaning, meaning

_NUMBER = rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_INTEGER = rb"-?[0-9]{1,10}"
_SEPARATOR = rb"\s*[,;\t ]\s*"
_COLUMN = re.compile(rb"(?<![^,;\t :=])" + _NUMBER + rb"(?![^,;\t ])")
_PAIR = re.compile(rb"\s*([A-Za-z_][\w .\[\]()/%-]*?)\s*[:=]\s*(" + _NUMBER + rb")\s*")

#: What a block of samples can carry, as `column_names` calls it.
_CHANNELS = (
    "voltage_V",
    "current_A",
    "position_rad",
    "position_counts",
    "velocity_rad_s",
    "torque_Nm",
    "temperature_C",
)
_MOTION = frozenset({"position_rad", "position_counts", "velocity_rad_s"})
#: `micros()` and `millis()` are counters of 32 bits.
_UINT32 = 1 << 32


@dataclass(frozen=True)
class TextFormat:
    """The columns of a line.

    Attributes:
        names: as they are sent.
        meanings: of them; None: passed over.
        pairs: every value has its name before it.
        whole: only whole numbers, as the default has them.
    """

    names: tuple[str, ...]
    meanings: tuple[Meaning | None, ...]
    pairs: bool = False
    whole: bool = False

    @cached_property
    def line(self) -> re.Pattern[bytes]:
        """A line, with a group for every value unless they are whole numbers."""
        if self.whole:
            return re.compile(rb"[0-9]{1,10}([,;\t])" + rb"\1".join([_INTEGER] * (len(self.names) - 1)))
        before = [re.escape(n.encode()) + rb"\s*[:=]\s*" if self.pairs else b"" for n in self.names]
        return re.compile(rb"\s*" + _SEPARATOR.join(b + rb"(" + _NUMBER + rb")" for b in before) + rb"\s*[,;]?\s*")

    def index(self, column: str) -> int | None:
        """Where a column is; None: it is not sent."""
        return next((i for i, m in enumerate(self.meanings) if m is not None and m.column == column), None)

    def samples_in(self, line: bytes) -> float:
        """How many samples a line was that cannot be read. Where only their number dates them, as many as it has
        columns for: a message between two samples was none, one in the middle of a sample does not make it two."""
        if self.time is not None:
            return 1.0
        found = _COLUMN.findall(line)
        return len(found) / len(self.names) if re.search(_SEPARATOR, line.strip()) else 0.0

    @property
    def channels(self) -> tuple[str, ...]:
        """Of `_CHANNELS`, those that are sent."""
        return tuple(c for c in _CHANNELS if self.index(c) is not None)

    @property
    def time(self) -> tuple[int, float, int | None] | None:
        """Where the time is, µs in one of its units, and where it wraps, µs; None: no time is sent."""
        index = self.index("time_s")
        if index is None:
            return None
        found = self.meanings[index]
        assert found is not None
        unit_us = found.scale * 1e6
        return index, unit_us, round(_UINT32 * unit_us) if found.told and found.scale < 1.0 else None


def _formed(names: Sequence[str], *, pairs: bool = False) -> TextFormat | None:
    """The format of named columns; None: they make no sample."""
    found = [meaning(name) for name in names]
    kept: list[Meaning | None] = []
    for m in found:
        usable = m is not None and m.certain and m.column in ("time_s", *_CHANNELS)
        again = usable and m is not None and any(k is not None and k.column == m.column for k in kept)
        kept.append(m if usable and not again else None)
    made = TextFormat(tuple(names), tuple(kept), pairs)
    there = set(made.channels)
    return made if len(there) > 1 and ("voltage_V" in there or there & _MOTION) else None


def _default() -> TextFormat:
    made = _formed(("t_us", "mV", "mA", "counts"))
    assert made is not None
    return TextFormat(made.names, made.meanings, whole=True)


DEFAULT = _default()


def named_format(text: str) -> TextFormat | None:
    """The format that a header line names ("t_us,mV,mA,counts"); None: it is none."""
    text = text.strip().lstrip("#").strip()
    for separator in ",;\t ":
        names = [name.strip() for name in text.split(separator) if name.strip()]
        if len(names) > 1 and not any(name[0].isdigit() for name in names):
            made = _formed(names)
            if made is not None:
                return TextFormat(made.names, made.meanings, whole=names == list(DEFAULT.names))
    return None


def pair_format(line: bytes) -> TextFormat | None:
    """The format of a line of `name:value` pairs; None: it is none."""
    names, at = [], 0
    while match := _PAIR.match(line, at):
        names.append(match[1].decode("ascii", "replace"))
        at = match.end()
        if at < len(line) and line[at : at + 1] in b",;\t":
            at += 1
    return _formed(names, pairs=True) if at == len(line) and len(names) > 1 else None
