"""From column names and metadata to what is in a capture: the part CSV and Parquet share."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from servo_daemon.captures.capture.model import LINEAR_COLUMNS, NUMERIC_METADATA, Axis, capture_error
from servo_daemon.errors import BadInputError
from servo_daemon.samples import CHANNELS
from servo_daemon.signal_meaning import KEYS, keys_of_texts

#: Column name in the file -> field of `Capture`.
KNOWN_COLUMNS: Mapping[str, str] = {"time_s": "time_s", **{c: c for c in CHANNELS}, **LINEAR_COLUMNS}

#: A line before the header that is one of the metadata.
METADATA_LINE = re.compile(r"#\s*([\w.-]+)\s*:\s*(.*)")

_ROTARY_ONLY = frozenset(LINEAR_COLUMNS.values())
_EFFORT = frozenset({"voltage_V", "current_A", "torque_Nm"})
MOTION = frozenset({"position_rad", "velocity_rad_s"})

NEEDED = (
    "time_s, one of position_rad, velocity_rad_s and one of voltage_V, current_A, torque_Nm "
    "(linear axis: position_m, velocity_m_s, force_N), or time_s, voltage_V, current_A"
)


@dataclass(frozen=True, slots=True)
class Layout:
    """Which column of the file is what.

    Attributes:
        width: number of columns in the file.
        columns: index in the file -> (name in the file, field of `Capture`), used columns only.
        axis: rotary or linear.
        notes: sentences about ignored columns.
    """

    width: int
    columns: Mapping[int, tuple[str, str]]
    axis: Axis
    notes: tuple[str, ...]


def make_layout(
    path: Path,
    names: Sequence[str],
    metadata: Mapping[str, str],
    *,
    line: int | None = None,
    metadata_lines: Mapping[str, int] | None = None,
) -> Layout:
    """What the columns mean, checked.

    Args:
        names: column names as in the file.
        metadata: the capture's metadata.
        line: the header's line; None for a file without lines.
        metadata_lines: the line of each metadata key, for messages.

    Raises:
        CaptureError: duplicate columns, no usable set, rotary and linear columns mixed, impossible metadata.
    """
    stripped = [name.strip() for name in names]
    columns: dict[int, tuple[str, str]] = {}
    for index, name in enumerate(stripped):
        if name in KNOWN_COLUMNS:
            if stripped.index(name) != index:
                raise capture_error(path, "the column is there twice", line=line, column=name)
            columns[index] = (name, KNOWN_COLUMNS[name])
    _check_usable(path, stripped, columns, line)
    lines = metadata_lines or {}
    _check_numbers(path, metadata, lines)
    _check_meaning(path, metadata, lines)
    axis = _axis(path, columns, metadata, line=line, metadata_line=lines.get("axis"))
    return Layout(len(stripped), columns, axis, _notes(stripped, columns))


def lacks(fields: Collection[str]) -> str:
    """What is missing in these fields of `Capture` to make a capture; empty: nothing is."""
    if "time_s" not in fields:
        return "no column time_s"
    usable = (_EFFORT.intersection(fields) and MOTION.intersection(fields)) or {"voltage_V", "current_A"} <= set(fields)
    return "" if usable else "no usable set of columns"


def _check_usable(
    path: Path,
    names: Sequence[str],
    columns: Mapping[int, tuple[str, str]],
    line: int | None,
) -> None:
    fields = {field for _, field in columns.values()}
    lack = lacks(fields)
    if not lack:
        return
    shown = ", ".join(name or "(no name)" for name in names[:12]) + (", …" if len(names) > 12 else "")
    if "time_s" not in fields:
        raise capture_error(path, f"{lack} among: {shown}", line=line, column="time_s")
    raise capture_error(path, f"{lack} among: {shown}; needed: {NEEDED}", line=line)


def _check_numbers(path: Path, metadata: Mapping[str, str], lines: Mapping[str, int]) -> None:
    for key in NUMERIC_METADATA:
        text = metadata.get(key)
        if text is None:
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0.0):
            message = f"metadata {key}: {text!r} is not a number greater than zero"
            raise capture_error(path, message, line=lines.get(key))


def _check_meaning(path: Path, metadata: Mapping[str, str], lines: Mapping[str, int]) -> None:
    try:
        keys_of_texts(metadata)
    except BadInputError as error:
        key = next((k for k in KEYS if str(error).startswith(k)), "")
        raise capture_error(path, f"metadata {error}", line=lines.get(key)) from error


def _axis(
    path: Path,
    columns: Mapping[int, tuple[str, str]],
    metadata: Mapping[str, str],
    *,
    line: int | None,
    metadata_line: int | None,
) -> Axis:
    """Columns decide; the metadata must agree, and decide where no column tells (voltage and current alone)."""
    names = [name for name, _ in columns.values()]
    linear = [name for name in names if name in LINEAR_COLUMNS]
    rotary = [name for name in names if name in _ROTARY_ONLY]
    if linear and rotary:
        message = f"mixes the linear axis's {', '.join(linear)} with the rotary {', '.join(rotary)}"
        raise capture_error(path, message, line=line)
    said = metadata.get("axis")
    if said is not None and said not in ("linear", "rotary"):
        raise capture_error(path, f"metadata axis: {said!r} is neither linear nor rotary", line=metadata_line)
    if (said == "linear" and rotary) or (said == "rotary" and linear):
        message = f"metadata axis: {said} does not fit the column {(rotary or linear)[0]}"
        raise capture_error(path, message, line=metadata_line)
    return "linear" if linear or said == "linear" else "rotary"


def _notes(names: Sequence[str], columns: Mapping[int, tuple[str, str]]) -> tuple[str, ...]:
    ignored = [name or f"number {i + 1} (no name)" for i, name in enumerate(names) if i not in columns]
    if not ignored:
        return ()
    return (f"unknown column{'s' if len(ignored) > 1 else ''} ignored: {', '.join(ignored)}",)
