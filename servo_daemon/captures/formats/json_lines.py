"""JSON lines: an object a line, as loggers and moteus tview write them.

What is nested becomes a path (`data.position`). Lines with a `channel` and `data` (moteus) hold several tables in one
file, each with the time stamps of its own lines: their signals are called `channel.name`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, TextIO

import numpy as np

from servo_daemon.captures.capture.bounded import MAX_OBJECTS, check_cells
from servo_daemon.captures.capture.model import MIN_SAMPLES, capture_error
from servo_daemon.captures.columns.foreign import Series
from servo_daemon.captures.columns.held import HeldSignal, describe
from servo_daemon.captures.columns.signal_map import SignalRef
from servo_daemon.captures.formats.rows import Rows, numbers
from servo_daemon.samples import F64

_TIMES = ("timestamp", "time", "t")


class JsonRecording:
    """The signals of JSON lines."""

    kind: ClassVar[str] = "JSON lines"
    options: ClassVar[tuple[str, ...]] = ()
    header_line: ClassVar[int | None] = None

    def __init__(self, path: Path, tables: Mapping[str, Rows]) -> None:
        self.path, self._tables = path, tables
        self.metadata: Mapping[str, str] = {}
        self.told = ["JSON lines"]
        self.timed = len(tables) > 1
        self._sources: dict[str, tuple[Rows, str]] = {}
        held = []
        for channel, table in tables.items():
            for name, column in table.columns.items():
                if self.timed and name in _TIMES:
                    continue
                whole = f"{channel}.{name}" if self.timed else name
                self._sources[whole] = (table, name)
                held.append(HeldSignal(whole, str(len(column)), plain=name))
        self.held = tuple(held)

    def read(self, ref: SignalRef) -> Series:
        source = self._sources.get(ref.signal)
        if source is None or ref.label != ref.signal:
            raise capture_error(self.path, f"no such signal; there are {describe(self.held)}", column=ref.label)
        table, name = source
        values = np.array(table.columns[name])
        if not self.timed:
            return Series(values)
        time = next(table.columns[t] for t in _TIMES if t in table.columns)
        there = np.isfinite(values)
        stamps: F64 = np.array(time)
        return Series(values[there], stamps[there])

    def place(self, index: int) -> str:
        table = next(iter(self._tables.values()))
        return f"line {table.numbers[index]}" if not self.timed else f"sample {index + 1}"


def read_json_lines(path: Path, text: TextIO) -> JsonRecording:
    """The signals of an open file of JSON lines.

    Raises:
        CaptureError: a line is no JSON object, or there are fewer than two; the line is named.
    """
    tables: dict[str, Rows] = {}
    controllers: set[str] = set()
    cells = 0
    for number, entry in _lines(path, text):
        if not isinstance(entry, dict):
            raise capture_error(path, "not a JSON object with a name for every value", line=number)
        channel = ""
        if isinstance(entry.get("data"), dict) and "channel" in entry:
            channel = str(entry["channel"])
            controllers.add(str(entry.get("controller", "")))
            times = {key: entry[key] for key in _TIMES if key in entry}
            values = dict(numbers({**times, **entry["data"]}, ""))
        else:
            values = dict(numbers(entry, ""))
        cells += len(values)
        check_cells(path, cells, 1, MAX_OBJECTS)
        tables.setdefault(channel, Rows()).add(number, values)
    if len(controllers) > 1:
        there = ", ".join(sorted(controllers))
        raise capture_error(path, f"holds the controllers {there}: leave the lines of one in a file of its own")
    tables = {c: t for c, t in tables.items() if len(t.numbers) >= MIN_SAMPLES}
    if not tables:
        raise capture_error(path, f"fewer than {MIN_SAMPLES} samples in JSON lines")
    if len(tables) > 1:
        tables = {c: t for c, t in tables.items() if any(name in t.columns for name in _TIMES)}
    return JsonRecording(path, tables)


def _lines(path: Path, text: Iterable[str]) -> Iterator[tuple[int, Any]]:
    """Line and value of every object."""
    for number, line in enumerate(text, 1):
        if not line.strip():
            continue
        if not line.endswith("\n"):  # the last one: a logger that is stopped cuts it off
            try:
                yield number, json.loads(line)
            except (ValueError, RecursionError):
                return
            continue
        yield number, _parsed(path, line, number)


def _parsed(path: Path, text: str, number: int) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise capture_error(path, f"not JSON: {error}", line=number) from error
