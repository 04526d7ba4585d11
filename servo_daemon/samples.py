"""The one form in which samples travel: from a driver through the pipeline to every estimator."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntFlag
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

#: A sample comes after a gap where its distance to the one before exceeds this multiple of the median period. One lost
#: sample of an evenly sampled drive shows as 2.0. The jitter of host-side time stamps has to stay below: the real
#: ODrive captures poll at 0.65 .. 1.34 (99 %) of their median, XL330 at 0.96 .. 1.11. 1.75 lies between and still sees
#: one lost sample where the period itself varies by up to 12 %.
GAP_FACTOR = 1.75
#: Measured channels a block may carry; a drive that lacks one leaves it None.
CHANNELS = (
    "voltage_V",
    "current_A",
    "position_rad",
    "velocity_rad_s",
    "temperature_C",
    "torque_Nm",
)
_BESIDE_TIME = ("sequence", "quality", *CHANNELS)


class Quality(IntFlag):
    """Why a sample is not as good as it looks. 0 is a good sample; bits combine."""

    GOOD = 0
    GAP_BEFORE = 1  # samples are missing between the one before and this one
    VOLTAGE_INVALID = 2  # the channel's value is not a measurement (not finite, frozen, flagged by the drive)
    CURRENT_INVALID = 4
    POSITION_INVALID = 8
    TIME_RESTART = 16  # device time jumped back before this sample: the device restarted
    SATURATED = 32  # the drive reports that its output or a converter is at its limit


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Consecutive samples of one drive, n >= 1, in the order the device took them.

    `time_s` is device time, unwrapped and strictly increasing within the block (it drives the physics);
    `host_time_s` is the host's monotonic clock when the last byte of the block arrived (it only measures
    delivery). `voltage_V[k]` was applied from `time_s[k]` until `time_s[k + 1]` (zero-order hold).
    On a linear axis positions are metres and torques newtons in the same fields; the capture says so.

    Attributes:
        time_s: shape (n,), s, device time.
        sequence: shape (n,), running number of the sample, unwrapped; gaps in it are lost samples.
        quality: shape (n,), bits of `Quality`.
        host_time_s: s, monotonic host clock at reception.
        voltage_V, current_A, position_rad, velocity_rad_s, temperature_C, torque_Nm: shape (n,) or None.
            Position is continuous (unwrapped), counted from where the device counts from.
        current_mean: the current is the mean over the interval that ends at its sample, not its value there.
    """

    time_s: F64
    sequence: I64
    quality: U8
    host_time_s: float
    voltage_V: F64 | None = None
    current_A: F64 | None = None
    position_rad: F64 | None = None
    velocity_rad_s: F64 | None = None
    temperature_C: F64 | None = None
    torque_Nm: F64 | None = None
    current_mean: bool = False
    # Asked for several times of each block; looked up once.
    _all_good: bool | None = field(default=None, init=False, repr=False, compare=False)
    _channels: tuple[str, ...] | None = field(default=None, init=False, repr=False, compare=False)
    _steps_s: tuple[float, float] | None = field(default=None, init=False, repr=False, compare=False)
    # No step is longer: of a part of a block that is known of the whole.
    _most_s: float = field(default=math.inf, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        n = self.time_s.shape[0]
        self.time_s.setflags(write=False)
        for name in _BESIDE_TIME:
            array = getattr(self, name)
            if array is None:
                continue
            if array.shape != (n,):
                raise ValueError(f"{name} has shape {array.shape}, time_s has ({n},)")
            array.setflags(write=False)

    def __len__(self) -> int:
        return int(self.time_s.shape[0])

    @property
    def all_good(self) -> bool:
        """Whether no sample has any flag: the usual case."""
        if self._all_good is None:
            object.__setattr__(self, "_all_good", not np.logical_or.reduce(self.quality))
        return bool(self._all_good)

    @property
    def steps_s(self) -> tuple[float, float]:
        """The least and the largest distance from one sample to the next; infinity and 0 of a single sample."""
        if self._steps_s is None:
            steps, found = self.time_s[1:] - self.time_s[:-1], (math.inf, 0.0)
            if len(steps):
                found = float(np.minimum.reduce(steps)), float(np.maximum.reduce(steps))
            object.__setattr__(self, "_steps_s", found)
            object.__setattr__(self, "_most_s", found[1] if found[1] == found[1] else math.inf)
        return self._steps_s or (math.inf, 0.0)

    def steps_within(self, most_s: float) -> bool:
        """Whether no sample is further from the one before it."""
        return self._most_s <= most_s or self.steps_s[1] <= most_s

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels this block carries, in the order of `CHANNELS`."""
        if self._channels is None:
            carried = tuple(name for name in CHANNELS if getattr(self, name) is not None)
            object.__setattr__(self, "_channels", carried)
        return self._channels or ()

    @property
    def end(self) -> SampleBlock:
        """The last sample."""
        return self.slice(len(self) - 1, len(self))

    def slice(self, start: int, stop: int) -> SampleBlock:
        """Samples start..stop-1 as a block of their own (views, no copy)."""
        if start == 0 and stop >= len(self):
            return self
        part = self._with(lambda values: values[start:stop])
        return part._knowing(self._all_good or None, self.channels, self._most_s)

    def _knowing(self, all_good: bool | None, channels: tuple[str, ...], most_s: float) -> SampleBlock:
        """The same block, of which so much is known without looking."""
        object.__setattr__(self, "_all_good", all_good)
        object.__setattr__(self, "_channels", channels)
        object.__setattr__(self, "_most_s", most_s)
        return self

    def select(self, keep: NDArray[np.bool_]) -> SampleBlock:
        """The samples for which `keep`, shape (n,), is true; possibly none (a copy)."""
        return self._with(lambda values: values[keep])

    def _with(self, chosen: Callable[[Any], Any]) -> SampleBlock:
        """The samples that are chosen of each array."""
        channels: dict[str, Any] = {n: None if (a := getattr(self, n)) is None else chosen(a) for n in CHANNELS}
        times = chosen(self.time_s), chosen(self.sequence), chosen(self.quality)
        return SampleBlock(*times, self.host_time_s, current_mean=self.current_mean, **channels)


def make_block(
    time_s: F64,
    *,
    sequence: I64 | None = None,
    quality: U8 | None = None,
    host_time_s: float = 0.0,
    current_mean: bool = False,
    **channels: F64 | None,
) -> SampleBlock:
    """A block from arrays; without them `sequence` counts from 0 and `quality` is good."""
    n = time_s.shape[0]
    return SampleBlock(
        time_s=time_s,
        sequence=np.arange(n, dtype=np.int64) if sequence is None else sequence,
        quality=np.zeros(n, dtype=np.uint8) if quality is None else quality,
        host_time_s=host_time_s,
        current_mean=current_mean,
        **channels,
    )


def concatenate(blocks: Sequence[SampleBlock]) -> SampleBlock:
    """Consecutive blocks as one. All must carry the same channels.

    Raises:
        ValueError: no block, or blocks with different channels.
    """
    if not blocks:
        raise ValueError("no blocks to concatenate")
    if len(blocks) == 1:
        return blocks[0]
    channels, last = blocks[0].channels, blocks[-1]
    if any(b.channels != channels for b in blocks):
        raise ValueError(f"blocks carry different channels: {sorted({b.channels for b in blocks})}")
    joined = {n: np.concatenate([getattr(b, n) for b in blocks]) for n in ("time_s", "sequence", "quality", *channels)}
    block = SampleBlock(**joined, host_time_s=last.host_time_s, current_mean=last.current_mean)
    steps = [float(b.time_s[0]) - float(a.time_s[-1]) for a, b in pairwise(blocks)]
    steps += [b._most_s for b in blocks]
    most_s = max(steps) if math.isfinite(sum(steps)) else math.inf
    return block._knowing(all(b._all_good for b in blocks) or None, channels, most_s)
