"""What is taken out of the ring at once: all series of some rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64

I8 = NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class RingRows:
    """Rows of all series, as they were appended.

    Attributes:
        first, next: number of the first row and of the one after the last; more than was asked for: those in between
            are no longer kept.
        time_s: (n,) UTC seconds since the epoch.
        names, units, is_parameter: of the S series.
        value, std: (n, S), NaN where not known; code: (n, S) into `STATUS_BY_CODE`, 0 of a state channel.
        truth: (n,) each, of a simulated drive's parameters.
    """

    first: int
    next: int
    time_s: F64
    names: tuple[str, ...]
    units: tuple[str | None, ...]
    is_parameter: tuple[bool, ...]
    value: F64
    std: F64
    code: I8
    truth: Mapping[str, F64]
