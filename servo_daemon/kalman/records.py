"""What the filter is told and what it answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64


@dataclass(frozen=True, slots=True)
class NoiseLevels:
    """Variances the filter works with.

    Attributes:
        input_var: of the held input (V², A² or (N·m)²).
        torque_psd: of a white load torque, (N·m)²·s.
        channel_var: per measured channel, in its unit squared.
    """

    input_var: float
    torque_psd: float
    channel_var: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Innovations:
    """What a run of samples had to say to the filter; shape (n, channels) each. What is no measurement says nothing:
    innovation 0, variance 1, so that it is nothing in a likelihood."""

    innovation: F64
    variance: F64
    gated: F64

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which samples are measurements, shape (n, channels)."""
        return np.asarray(self.innovation != 0.0)

    @property
    def possible(self) -> bool:
        """Whether a filter could run over the samples at all: far off its state and variances overflow."""
        return bool(np.isfinite(self.innovation).all() and (self.variance > 0.0).all())


@dataclass(frozen=True, slots=True)
class ChannelStatistics:
    """A run of one channel's innovations ν with variances s, standing encoders left out.

    Attributes:
        count: how many.
        nis: mean of ν²/s.
        excess: mean of ν² − s, outliers clipped.
        correlation: lag-1, of ν/√s.
        gated: how many were weighted down as outliers (of all).
        crossed: correlation with the first channel's ν/√s one sample earlier.
    """

    count: float
    nis: float
    excess: float
    correlation: float
    gated: float
    crossed: float

    @classmethod
    def of(cls, sums: Sequence[float]) -> ChannelStatistics:
        """From `layout.STATISTICS`."""
        count, nis, excess, lagged, _, gated, crossed = sums
        n = max(count, 1.0)
        return cls(count, nis / n, excess / n, lagged / max(nis, 1e-12), gated, crossed / n)

    def joined(self, other: ChannelStatistics) -> ChannelStatistics:
        """The statistics of both runs as of one."""
        count = self.count + other.count
        if count < 1:
            return other
        a, b = self.count / count, other.count / count
        nis = a * self.nis + b * other.nis
        lagged = a * self.nis * self.correlation + b * other.nis * other.correlation
        excess = a * self.excess + b * other.excess
        crossed = a * self.crossed + b * other.crossed
        return ChannelStatistics(count, nis, excess, lagged / max(nis, 1e-12), self.gated + other.gated, crossed)
