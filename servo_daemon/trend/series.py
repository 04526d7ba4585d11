"""What a trend is found from: means of hours or days, and their reduction to a hundred and sixty equal stretches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servo_daemon.config_texts import UNIT_S
from servo_daemon.numerics import STD_OF_MEDIAN
from servo_daemon.samples import F64

YEAR_D: Final = UNIT_S["y"] / UNIT_S["d"]
#: Stretches at most: five years in steps of twelve days. Covariances of this size are factored in a millisecond.
MOST_STRETCHES: Final = 160
#: A stretch whose value is this many robust standard deviations from its neighbours' median is left out; of normal
#: noise one in two million is.
_OUTLIER_STD: Final = 5.0
_NEIGHBOURS: Final = 9


@dataclass(frozen=True, slots=True)
class Series:
    """One parameter over time, oldest first; all arrays have shape (n,).

    Attributes:
        time_d: days, increasing; any zero.
        value: finite, in the parameter's unit.
        temperature_C: of the winding; NaN where it was not known. None: never.
        days: how many days of data each value stands for, > 0.
    """

    time_d: F64
    value: F64
    temperature_C: F64 | None
    days: F64

    def __len__(self) -> int:
        return len(self.time_d)

    def since(self, day: float) -> Series:
        """What came at that time or later."""
        first = int(np.searchsorted(self.time_d, day))
        warm = None if self.temperature_C is None else self.temperature_C[first:]
        return Series(self.time_d[first:], self.value[first:], warm, self.days[first:])


def daily(time_d: F64, value: F64, temperature_C: F64 | None) -> Series:
    """Medians of whole days; the temperature is kept if it was known on every day.

    Raises:
        ValueError: shapes that differ, or times that decrease.
    """
    if time_d.shape != value.shape or (temperature_C is not None and temperature_C.shape != value.shape):
        raise ValueError(f"time {time_d.shape}, value {value.shape} and temperature must have one shape")
    if np.any(np.diff(time_d) < 0):
        raise ValueError("time_d decreases")
    warm = np.full(len(value), np.nan) if temperature_C is None else temperature_C
    known = np.isfinite(value) & np.isfinite(time_d)
    rows = _medians(np.column_stack([time_d, value, warm, np.ones_like(value)])[known], 1.0)
    return _series(np.column_stack([rows[:, :3], np.ones(len(rows))]))


def stretched(days: Series) -> Series:
    """Medians of equal stretches of whole days, at most `MOST_STRETCHES`; those far from their neighbours left out."""
    if not len(days):
        return days
    warm = np.full(len(days), np.nan) if days.temperature_C is None else days.temperature_C
    width_d = max(1.0, float(np.ceil((days.time_d[-1] - days.time_d[0]) / MOST_STRETCHES)))
    rows = _medians(np.column_stack([days.time_d, days.value, warm, days.days]), width_d)
    return _series(rows[_usual(rows[:, 1])])


def _series(rows: F64) -> Series:
    warm = rows[:, 2] if len(rows) and np.isfinite(rows[:, 2]).all() else None
    return Series(rows[:, 0], rows[:, 1], warm, rows[:, 3])


def _medians(rows: F64, width_d: float) -> F64:
    """Medians of the columns over stretches of `width_d`; of the last column the sum. Shapes (n, 4) and (m, 4)."""
    if not len(rows):
        return rows
    stretch = np.floor((rows[:, 0] - np.floor(rows[0, 0])) / width_d)
    starts = np.flatnonzero(np.diff(stretch, prepend=-1.0))
    counts = np.diff(np.append(starts, len(rows)))
    padded = np.full((len(starts), int(counts.max()), rows.shape[1]), np.nan)
    within = np.arange(len(rows)) - np.repeat(starts, counts)
    padded[np.repeat(np.arange(len(starts)), counts), within] = rows
    out = _nanmedian(padded)
    out[:, 0] = np.add.reduceat(rows[:, 0], starts) / counts
    out[:, -1] = np.add.reduceat(rows[:, -1], starts)
    return out


def _nanmedian(padded: F64) -> F64:
    """Along the second axis; NaN where all are, without numpy's warning."""
    ordered = np.sort(padded, axis=1)  # NaN last
    count = np.isfinite(padded).sum(axis=1)
    low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0)[:, None], axis=1)[:, 0]
    high = np.take_along_axis(ordered, np.minimum(count // 2, padded.shape[1] - 1)[:, None], axis=1)[:, 0]
    return np.where(count > 0, 0.5 * (low + high), np.nan)


def _usual(value: F64) -> NDArray[np.bool_]:
    """Which values are near their neighbours' median; shape (n,)."""
    if len(value) < _NEIGHBOURS:
        return np.ones(len(value), dtype=bool)
    padded = np.pad(value, _NEIGHBOURS // 2, mode="edge")
    away = np.abs(value - np.median(np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS), axis=1))
    usual = STD_OF_MEDIAN * np.median(away)
    return away <= _OUTLIER_STD * usual if usual > 0 else np.ones(len(value), dtype=bool)
