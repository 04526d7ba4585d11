"""One finding about a column, and the words of its mend."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from servo_daemon.captures.capture.model import LINEAR_COLUMNS, Capture

#: What it means for a fit: only to be told; some samples of the current count as not measured; some rows, or the
#: column, must be left out; the capture cannot be used so.
Weight = Literal["told", "samples", "rows", "column", "capture"]
#: Of a signal map, a position that is counted.
_COUNTS = "position_counts"


@dataclass(frozen=True, slots=True)
class Finding:
    """What is odd about a column.

    Attributes:
        column: field of `Capture`.
        text: what is seen, what it probably is, and the line that mends it.
        weight: whether it can be fitted so.
        where: the samples, shape (n,), of the weight "samples".
    """

    column: str
    text: str
    weight: Weight = "told"
    where: NDArray[np.bool_] | None = None


def column_name(capture: Capture, field: str) -> str:
    """A field of `Capture` as the file calls it."""
    if capture.axis == "linear":
        return next((name for name, of in LINEAR_COLUMNS.items() if of == field), field)
    return field


def has_time(capture: Capture) -> bool:
    """Whether the time is one of the file's signals, which a signal map can change."""
    return _line(capture, "time_s") is not None


def mend(capture: Capture, field: str, keys: Mapping[str, object], *, target: str | None = None) -> str:
    """The words that tell how to say it: a signal map of one line with everything that the capture has, by the file's
    own names and units.

    Args:
        field: whose line changes.
        keys: what is added to it; a scale is one of the column's values as they are, a direction the column (0 or 1)
            that turns them, a zero their reading where there is none of it.
        target: the column it becomes, where that is another.
    """
    lines = {f: one for f in ("time_s", *capture.channels) if (one := _line(capture, f)) is not None}
    name, entry = lines.pop(field)
    lines[field] = target or name, _changed(capture, name, entry, keys)
    told = ", ".join(f"{name} = {_toml(_short(entry))}" for name, entry in lines.values())
    words = f"mend: --signals MAP.toml (docs/captures.md) with  signals = {{ {told} }}"
    if target == _COUNTS and name != _COUNTS:
        return f"{words}  and above it your encoder's  counts_per_rev = 4096"
    if _COUNTS in {name for name, _ in lines.values()}:
        return f"{words}  and above it  counts_per_rev = {_toml(capture.as_map['counts_per_rev'])}"
    return words


def _line(capture: Capture, field: str) -> tuple[str, Mapping[str, object]] | None:
    """A field's column in a signal map, and its entry; None: the time is none of the file's signals."""
    lines = capture.as_map.get("signals", {})
    for name, entry in lines.items():
        if field == ("position_rad" if name == _COUNTS else LINEAR_COLUMNS.get(name, name)):
            return name, entry
    if lines and field == "time_s":
        return None
    name = column_name(capture, field)
    return name, {"signal": name}


def _changed(capture: Capture, name: str, entry: Mapping[str, object], keys: Mapping[str, object]) -> dict[str, object]:
    """An entry with other keys. A wrap is one of the column's values; of counts it is in counts."""
    if "direction" in keys:
        value = entry if "formula" in entry else {"formula": "Value", "Value": entry}
        turned = f"({value['formula']}) * (1 - 2 * Direction)"
        return {**value, "formula": turned, "Direction": keys["direction"]}
    if "zero" in keys:
        value = entry if "formula" in entry else {"formula": "Value", "Value": entry}
        return {**value, "formula": f"({value['formula']} - {_toml(keys['zero'])}) * {_toml(keys['scale'])}"}
    changed = {**entry, **keys}
    if "rows_late" in keys:
        changed["rows_late"] = keys["rows_late"] + entry.get("rows_late", 0)  # type: ignore[operator]
    if (scale := keys.get("scale")) is not None:
        if "formula" in entry:
            changed["formula"] = f"({entry['formula']}) * {_toml(scale)}"
            del changed["scale"]
        else:
            changed["scale"] = scale * float(entry.get("scale", 1.0))  # type: ignore[arg-type, operator]
    if name == _COUNTS and "wrap" in keys:
        changed["wrap"] = keys["wrap"] / (2 * math.pi) * abs(capture.as_map["counts_per_rev"])  # type: ignore[operator]
    return changed


def _short(entry: Mapping[str, object]) -> object:
    return entry["signal"] if entry.keys() == {"signal"} else entry


def _toml(value: object) -> str:
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_toml(_of_operand(one))}' for key, one in value.items())} }}"
    if isinstance(value, float):
        return f"{value:.10g}"
    return json.dumps(value, ensure_ascii=False)


def _of_operand(value: object) -> object:
    return _short(value) if isinstance(value, Mapping) else value
