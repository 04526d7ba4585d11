"""One finding about a column, and the words of its mend."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from servo_daemon.captures.capture.model import LINEAR_COLUMNS, Capture

#: What it means for a fit: only to be told; the column must be left out; the capture cannot be used so.
Weight = Literal["told", "column", "capture"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What is odd about a column.

    Attributes:
        column: field of `Capture`.
        text: what is seen, what it probably is, and the line that mends it.
        weight: whether it can be fitted so.
    """

    column: str
    text: str
    weight: Weight = "told"


def column_name(capture: Capture, field: str) -> str:
    """A field of `Capture` as the file calls it."""
    if capture.axis == "linear":
        return next((name for name, of in LINEAR_COLUMNS.items() if of == field), field)
    return field


def mend(capture: Capture, field: str, keys: Mapping[str, object], *, target: str | None = None) -> str:
    """The words that tell how to say it: a signal map of one line with everything that the capture has.

    Args:
        field: whose line changes.
        keys: what is added to it.
        target: the column it becomes, where that is another.
    """
    name = column_name(capture, field)
    added = "".join(f", {key} = {_toml(value)}" for key, value in keys.items())
    line = f"{target or name} = {{ signal = {_toml(name)}{added} }}" if keys else f"{target} = {_toml(name)}"
    others = [column_name(capture, f) for f in ("time_s", *capture.channels) if f != field]
    whole = ", ".join([*(f"{other} = {_toml(other)}" for other in others), line])
    return f"mend: --signals MAP.toml (docs/captures.md) with  signals = {{ {whole} }}"


def _toml(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.10g}"
    return json.dumps(value, ensure_ascii=False)
