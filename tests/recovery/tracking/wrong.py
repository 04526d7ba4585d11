"""What counts as wrong, for how long, and how runs are shared out and written down: the same for every part that asks
whether what is said is true."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.tracking.follow import Flags

#: A value is wrong that is off by more than so many of its own std and by more than this share of the truth
#: (issue 25: "beyond 4 σ and 3 %").
WRONG_STDS, WRONG_SHARE = 4.0, 0.03
#: Share of the time that a regression may be wrong (issue 25).
WRONG_LIMIT = 0.01
#: A parameter may be wrong for so long at a stretch, s (issue 25).
WRONG_S = 5.0
#: A value with a std beyond this share of it delivers nothing (issue 25).
DELIVERS = 0.25
#: Ticks are 0.1 s apart.
TICK_S = 0.1


class Named(Protocol):
    """A run has a key: a text that is given to `--only`."""

    @property
    def key(self) -> str: ...


Job = TypeVar("Job")
Row = TypeVar("Row")
NamedRun = TypeVar("NamedRun", bound=Named)


def wrong(value: F64, std: F64, truth: F64) -> Flags:
    """Where a value is said, with a std, and is wrong; all shapes (m, parameters)."""
    error = np.abs(value - truth)
    with np.errstate(invalid="ignore"):  # NaN: nothing is said
        return np.asarray((error > WRONG_STDS * std) & (error > WRONG_SHARE * np.abs(truth)))


def delivered(value: F64, std: F64) -> Flags:
    """Where a value is said with a std that makes it one; shapes (m, parameters)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(std < DELIVERS * np.abs(value))


def longest_s(flags: Flags) -> F64:
    """The longest stretch of ticks in each column, s, shape (parameters,)."""
    longest = np.zeros(flags.shape[1])
    running = np.zeros(flags.shape[1])
    for row in flags:
        running = np.where(row, running + TICK_S, 0.0)
        longest = np.maximum(longest, running)
    return longest


def chosen(runs: Sequence[NamedRun], only: str) -> list[NamedRun]:
    """The run with this key; without one, those whose key contains the text."""
    named = [run for run in runs if run.key == only]
    return named or [run for run in runs if only in run.key]


def each(run: Callable[[Job], Row], jobs: Sequence[Job], processes: int) -> Iterator[Row]:
    """The runs' rows in their order, as they come."""
    if processes <= 1:
        yield from map(run, jobs)
        return
    with ProcessPoolExecutor(min(processes, os.cpu_count() or 1)) as pool:
        yield from pool.map(run, jobs)


class Journal:
    """One JSON line a run in a file, so that two versions of the code can be compared; nothing without a path."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        if path is not None:
            path.write_text("")

    def write(self, row: Mapping[str, Any]) -> None:
        """Arrays become lists, what is not a number null."""
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(json.dumps(_plain(row), ensure_ascii=False) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
