"""What was published over a span of time, in rows or summed up in buckets: one row a bucket, one column a series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servo_daemon.published.history import STATUS_BY_CODE
from servo_daemon.samples import F64

I32 = NDArray[np.int32]

#: Ends the name of the series that holds a simulated drive's true value of a parameter.
TRUTH: Final = "_true"
#: Statuses that a parameter can have; `Buckets.status` has one layer for each, in the order of STATUS_BY_CODE[1:].
STATUSES: Final[tuple[str, ...]] = STATUS_BY_CODE[1:]
_NOT_KNOWN: Final = tuple(STATUS_BY_CODE.index(status) for status in ("estimating", "invalid"))


@dataclass(frozen=True, slots=True, eq=False)
class Buckets:
    """n buckets of S series. Rows as they were published are buckets of one row each, `period_s` 0.

    Attributes:
        period_s: length of a bucket, s; 0: single rows.
        time_s: (n,) begin of each bucket (of a row: its time), UTC seconds since the epoch.
        names, units: of the S series; parameters first or mixed with state channels.
        is_parameter: whether a series is a parameter (it then has `std` and `status`).
        count: (n, S) rows with a known value.
        mean, low, high: (n, S) of the known values, in the series' unit; NaN where there is none. (The mean of a single
            row is the value as published, known or not.)
        spread: (n, S) standard deviation of the known values in the bucket; 0 of a single row.
        std: (n, S) root mean square of the published standard deviations; NaN where none was published.
        status: (n, S, len(STATUSES)) rows by status; all 0 of a state channel.
    """

    period_s: float
    time_s: F64
    names: tuple[str, ...]
    units: tuple[str | None, ...]
    is_parameter: tuple[bool, ...]
    count: I32
    mean: F64
    low: F64
    high: F64
    spread: F64
    std: F64
    status: I32

    def __len__(self) -> int:
        return int(self.time_s.shape[0])

    @classmethod
    def empty(cls, period_s: float = 0.0) -> Buckets:
        """Buckets without any row."""
        none, counts = np.empty((0, 0)), np.empty((0, 0), np.int32)
        layers = np.empty((0, 0, len(STATUSES)), np.int32)
        return cls(period_s, np.empty(0), (), (), (), counts, none, none, none, none, none, layers)

    @classmethod
    def of_rows(
        cls,
        time_s: F64,
        names: Sequence[str],
        units: Sequence[str | None],
        is_parameter: Sequence[bool],
        value: F64,
        std: F64,
        code: NDArray[np.int8],
    ) -> Buckets:
        """Single rows. What is `estimating` (the nominal value) or `invalid` (one that was held) is shown as it was
        published and counts for nothing: no bucket's mean holds it.

        Args:
            value, std: (n, S); NaN where not known.
            code: (n, S) codes into STATUS_BY_CODE; 0: none.
        """
        status = (code[:, :, None] == np.arange(1, len(STATUS_BY_CODE), dtype=np.int8)).astype(np.int32)
        known = np.isfinite(value) & ~np.isin(code, _NOT_KNOWN)
        counted = np.where(known, value, np.nan)
        return cls(
            0.0, time_s, tuple(names), tuple(units), tuple(is_parameter), known.astype(np.int32), value, counted,
            counted, np.where(known, 0.0, np.nan), np.where(known, std, np.nan), status,
        )  # fmt: skip

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Buckets:
        """The chosen rows."""
        return replace(
            self,
            time_s=self.time_s[rows],
            count=self.count[rows],
            mean=self.mean[rows],
            low=self.low[rows],
            high=self.high[rows],
            spread=self.spread[rows],
            std=self.std[rows],
            status=self.status[rows],
        )

    def select(self, names: Sequence[str]) -> Buckets:
        """The series of these names, as far as they are there, in this order."""
        chosen = [self.names.index(name) for name in names if name in self.names]
        return replace(
            self,
            names=tuple(self.names[k] for k in chosen),
            units=tuple(self.units[k] for k in chosen),
            is_parameter=tuple(self.is_parameter[k] for k in chosen),
            count=self.count[:, chosen],
            mean=self.mean[:, chosen],
            low=self.low[:, chosen],
            high=self.high[:, chosen],
            spread=self.spread[:, chosen],
            std=self.std[:, chosen],
            status=self.status[:, chosen],
        )
