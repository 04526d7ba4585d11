"""The last minutes of what was published, in memory: one ring of rows per drive, columns in NumPy arrays.

One thread appends, any number of threads query. The lock covers writing one row, or copying the four or five columns
of one series; selecting, sorting and decimating happen outside it.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Final, get_args

import numpy as np
from numpy.typing import NDArray

from servo_daemon.parameters import Status
from servo_daemon.published.ring_rows import I8, RingRows
from servo_daemon.published.snapshot import Estimate, Snapshot
from servo_daemon.published.units import split_unit
from servo_daemon.samples import F64

#: Status texts by code; 0 marks rows in which the parameter did not exist (the model had no such effect then).
STATUS_BY_CODE: Final[tuple[str, ...]] = ("", *get_args(Status))
_CODE_BY_STATUS: Final = {status: code for code, status in enumerate(STATUS_BY_CODE)}

#: Rows a second that are kept at most; faster publishing is thinned out.
RATE_HZ: Final = 10.0
#: Where rows are so far apart, s, the wall clock may have been set, and rows of earlier processes may lie between.
JUMP_S: Final = 60.0
#: 30 minutes at 10 Hz: 2.9 MB a drive with five parameters, their truth and three state channels.
DEFAULT_CAPACITY: Final = 18_000


@dataclass(frozen=True, slots=True)
class HistorySeries:
    """One parameter or state channel over time, oldest first; all arrays have shape (n,).

    Attributes:
        name, unit: what it is; `unit` is None where the name does not tell it.
        time_s: UTC seconds since the epoch, not decreasing.
        value, std: in `unit`; NaN where nothing was known (`std` of a state channel is NaN).
        status: codes into `STATUS_BY_CODE`, None for a state channel.
        truth: a simulated drive's true value, NaN where it was not known; None if it never was.
    """

    name: str
    unit: str | None
    time_s: F64
    value: F64
    std: F64
    status: I8 | None
    truth: F64 | None

    @classmethod
    def empty(cls, name: str, unit: str | None, *, parameter: bool) -> HistorySeries:
        """Of a parameter or a state channel of which no row is kept."""
        none = np.empty(0)
        return cls(name, unit, none, none, none, np.empty(0, np.int8) if parameter else None, None)

    def __len__(self) -> int:
        return int(self.time_s.shape[0])

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> HistorySeries:
        """The chosen rows as a series of their own."""
        return HistorySeries(
            self.name,
            self.unit,
            self.time_s[index],
            self.value[index],
            self.std[index],
            None if self.status is None else self.status[index],
            None if self.truth is None else self.truth[index],
        )


class _Columns:
    """The arrays of one name. A parameter has all of them, a state channel only `value`."""

    __slots__ = ("last_row", "status", "std", "truth", "unit", "value")

    def __init__(self, capacity: int, unit: str | None, *, parameter: bool) -> None:
        self.unit = unit
        self.value: F64 = np.full(capacity, np.nan)
        self.std: F64 | None = np.full(capacity, np.nan) if parameter else None
        self.status: I8 | None = np.zeros(capacity, dtype=np.int8) if parameter else None
        self.truth: F64 | None = None
        self.last_row = -1

    def clear(self, slot: int) -> None:
        self.value[slot] = np.nan
        if self.std is not None:
            self.std[slot] = np.nan
        if self.status is not None:
            self.status[slot] = 0
        if self.truth is not None:
            self.truth[slot] = np.nan


class HistoryRing:
    """Rows of published estimates, the newest `capacity` of them.

    Args:
        capacity: rows kept.
        rate_hz: rows a second kept at most, on average; snapshots in between are passed over.

    Parameters and state channels may come and go with the model: a name is known from its first row on until its last
    row has left the ring.
    """

    def __init__(self, capacity: int = DEFAULT_CAPACITY, rate_hz: float = RATE_HZ) -> None:
        if capacity < 1 or not rate_hz > 0:
            raise ValueError(f"capacity {capacity} and rate {rate_hz} Hz must be positive")
        self.capacity = capacity
        self.rate_hz = rate_hz
        self._lock = threading.Lock()
        self._time: F64 = np.full(capacity, np.nan)
        self._columns: dict[str, _Columns] = {}
        self._rows = 0  # ever appended; row k is in slot k % capacity
        self._last_time = math.nan
        self._whole_since = math.nan  # time has gone on without a jump since then
        self._due = -math.inf

    def __len__(self) -> int:
        return min(self._rows, self.capacity)

    def names(self) -> tuple[str, ...]:
        """Parameters and state channels that `query` knows, in the order in which they first appeared."""
        with self._lock:
            return tuple(self._columns)

    def append(self, snapshot: Snapshot) -> bool:
        """Keep this snapshot as a row. Called by one thread only.

        Returns:
            False where it was passed over: no samples yet, nothing new since the last row, or sooner than the rate.
        """
        time, estimate = snapshot.time, snapshot.estimate
        if time is None or estimate is None or not self.is_due(time):
            return False
        if not self._last_time <= time <= self._last_time + JUMP_S:
            self._whole_since = time
        self._schedule(time)
        with self._lock:
            slot = self._rows % self.capacity
            self._time[slot] = time
            for columns in self._columns.values():
                columns.clear(slot)
            self._write(slot, estimate, snapshot)
            self._rows += 1
            # A name whose last row has just been overwritten is forgotten, so memory follows the model.
            gone = [name for name, c in self._columns.items() if c.last_row <= self._rows - 1 - self.capacity]
            for name in gone:
                del self._columns[name]
        return True

    def is_due(self, time: float) -> bool:
        """Whether a snapshot of this time would be kept. A wall clock that was set back starts a new schedule."""
        return time < self._last_time or (time != self._last_time and time >= self._due - 0.5 / self.rate_hz)

    def _schedule(self, time: float) -> None:
        """Pacing by a schedule instead of by the distance to the last row, so that 10 Hz with jitter stays 10 Hz."""
        period = 1.0 / self.rate_hz
        due = -math.inf if time < self._last_time else self._due
        self._due = due + period if time < due + period else time + period
        self._last_time = time

    def _write(self, slot: int, estimate: Estimate, snapshot: Snapshot) -> None:
        for p in estimate.parameters:
            c = self._column(p.name, p.unit, parameter=True)
            c.last_row = self._rows
            c.value[slot] = np.nan if p.value is None else p.value
            if c.std is not None and c.status is not None:
                c.std[slot] = np.nan if p.std is None else p.std
                c.status[slot] = _CODE_BY_STATUS[p.status]
            true_value = None if snapshot.truth is None else snapshot.truth.get(p.name)
            if true_value is not None:
                if c.truth is None:
                    c.truth = np.full(self.capacity, np.nan)
                c.truth[slot] = true_value
        for name, value in estimate.state.items():
            c = self._column(name, split_unit(name)[1], parameter=False)
            c.last_row = self._rows
            c.value[slot] = np.nan if value is None else value

    def _column(self, name: str, unit: str | None, *, parameter: bool) -> _Columns:
        columns = self._columns.get(name)
        if columns is None:
            columns = self._columns[name] = _Columns(self.capacity, unit, parameter=parameter)
        return columns

    @property
    def rows(self) -> int:
        """Ever appended: the number of the next row."""
        return self._rows

    def holds(self, start_s: float) -> bool:
        """Whether all rows from then on, UTC seconds since the epoch, are here: none can be in a store alone."""
        with self._lock:
            n = len(self)
            oldest = float(self._time[self._rows % self.capacity if n == self.capacity else 0])
            return n > 0 and max(oldest, self._whole_since) <= start_s

    def since(self, row: int) -> RingRows:
        """The rows from number `row` on that are still kept, in the order in which they were appended."""
        with self._lock:
            first = max(row, self._rows - len(self))
            slots = np.arange(first, self._rows) % self.capacity
            known = np.isfinite(self._time[slots])
            slots = slots[known]
            shape = (len(slots), len(self._columns))
            value, std, code = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.int8)
            truth = {n: c.truth[slots] for n, c in self._columns.items() if c.truth is not None}
            for k, c in enumerate(self._columns.values()):
                value[:, k] = c.value[slots]
                if c.std is not None and c.status is not None:
                    std[:, k], code[:, k] = c.std[slots], c.status[slots]
            units = tuple(c.unit for c in self._columns.values())
            kinds = tuple(c.std is not None for c in self._columns.values())
            time = self._time[slots]
            return RingRows(first, self._rows, time, tuple(self._columns), units, kinds, value, std, code, truth)

    def query(
        self,
        name: str,
        start_s: float | None = None,
        end_s: float | None = None,
        points: int | None = None,
    ) -> HistorySeries:
        """Rows of one parameter or state channel with start_s <= time <= end_s, sorted by time.

        Args:
            name: one of `names()`.
            start_s, end_s: UTC seconds since the epoch, inclusive; None: no limit.
            points: at most so many rows (>= 2), thinned by `thin`; None: all.

        Raises:
            KeyError: no such name.
        """
        series = self._copy(name)
        wanted = np.isfinite(series.time_s)
        if start_s is not None:
            wanted &= series.time_s >= start_s
        if end_s is not None:
            wanted &= series.time_s <= end_s
        if series.status is not None:
            wanted &= series.status != 0
        series = series.take(wanted)
        # Stable, and nothing to do unless the host's clock was set back while the rows were made.
        if np.any(np.diff(series.time_s) < 0):
            series = series.take(np.argsort(series.time_s, kind="stable"))
        return series if points is None else thin(series, points)

    def _copy(self, name: str) -> HistorySeries:
        """All rows of one name in the order they were appended."""
        with self._lock:
            c = self._columns[name]
            n = len(self)
            head = self._rows % self.capacity if n == self.capacity else 0

            def unroll(array: F64) -> F64:
                return np.concatenate([array[head:n], array[:head]])

            return HistorySeries(
                name=name,
                unit=c.unit,
                time_s=unroll(self._time),
                value=unroll(c.value),
                std=np.full(n, np.nan) if c.std is None else unroll(c.std),
                status=None if c.status is None else np.concatenate([c.status[head:n], c.status[:head]]),
                truth=None if c.truth is None else unroll(c.truth),
            )


def thin(series: HistorySeries, points: int) -> HistorySeries:
    """At most `points` rows that keep the shape of the curve: the first, the last, and of equally many rows in between
    the lowest and the highest value. Every row that remains is one that was recorded, with its own std and status, so
    no peak is lost and nothing is averaged together that belongs to different states.

    Raises:
        ValueError: fewer than 2 points.
    """
    if points < 2:
        raise ValueError(f"points must be at least 2, not {points}")
    n = len(series)
    if n <= points:
        return series
    buckets = (points - 2) // 2
    keep = [np.array([0, n - 1], dtype=np.intp)]
    if buckets:
        width = -(-(n - 2) // buckets)
        inner = np.full(buckets * width, np.nan)
        inner[: n - 2] = series.value[1:-1]
        table = inner.reshape(buckets, width)
        unknown = np.isnan(table)
        first = 1 + np.arange(buckets, dtype=np.intp) * width
        for pick in (np.where(unknown, np.inf, table).argmin(1), np.where(unknown, -np.inf, table).argmax(1)):
            index = first + pick
            keep.append(index[index < n - 1])
    return series.take(np.unique(np.concatenate(keep)))
