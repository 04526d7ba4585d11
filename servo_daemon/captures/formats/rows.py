"""Numbers that come by name, message by message, as loggers of objects write them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from servo_daemon.captures.text.dialect import clock_seconds


@dataclass(slots=True)
class Rows:
    """The messages of one channel.

    Attributes:
        columns: numbers by name; NaN where a message has none.
        numbers: of each row, the line or the time (ns) that it came with.
    """

    columns: dict[str, list[float]] = field(default_factory=dict)
    numbers: list[int] = field(default_factory=list)

    def add(self, number: int, values: Mapping[str, float]) -> None:
        """A row; what a row lacks is NaN."""
        n = len(self.numbers)
        for name, value in values.items():
            self.columns.setdefault(name, [np.nan] * n).append(value)
        self.numbers.append(number)
        for column in self.columns.values():
            if len(column) <= n:
                column.append(np.nan)


def numbers(entry: Mapping[str, Any], path: str) -> Iterator[tuple[str, float]]:
    """Every number of an object, and every date, in s, by its path; true and false are none."""
    for key, value in entry.items():
        if isinstance(value, Mapping):
            yield from numbers(value, f"{path}{key}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{path}{key}", float(value)
        elif isinstance(value, str) and (seconds := clock_seconds(value)) is not None:
            yield f"{path}{key}", seconds
