"""Cuts a stream of blocks into ticks of device time, whatever the blocks' sizes.

Everything slower than a sample happens at ticks (`TICK_S` of device time, counted from the first sample), on exactly
the samples of that tick. So the result does not depend on how the samples were cut into blocks.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from servo_daemon.samples import F64, Quality, SampleBlock
from servo_daemon.tracking.plan.settings import TICK_S


@dataclass(frozen=True, slots=True)
class Segment:
    """Samples of one tick, or a part of them; `closes_tick`: the samples before it completed an earlier tick."""

    block: SampleBlock
    closes_tick: bool


class TickCutter:
    """Splits blocks at tick boundaries and keeps time increasing across them.

    Attributes:
        restarts: how often device time began anew, as the driver flagged it or as it shows here.
        repeated: samples without a time of their own, left out.
    """

    def __init__(self) -> None:
        self.start_s: float | None = None
        self.restarts = 0
        self.repeated = 0
        self._raw_last_s = -np.inf  # as the device dates it
        self._tick = 0
        self._last_s = -np.inf
        self._offset_s = 0.0
        self._period_s = 1e-3

    def cut(self, block: SampleBlock) -> list[Segment]:
        """Segments in order; each lies inside one tick."""
        return [segment for part in self._increasing(block) for segment in self._cut(self._continued(part))]

    def _cut(self, block: SampleBlock) -> list[Segment]:
        """A block whose time goes on from the last one's."""
        if not block.all_good:
            self.restarts += int(np.count_nonzero(block.quality & Quality.TIME_RESTART))
        if self.start_s is None:
            self.start_s = float(block.time_s[0])
        segments = []
        for a, b in pairwise(self._bounds(block.time_s)):
            tick = self._tick_of(float(block.time_s[a]))
            segments.append(Segment(block.slice(a, b), closes_tick=tick > self._tick))
            self._tick = tick
        # Of the stream's last two samples, whether or not they came in one block.
        before = float(block.time_s[-2]) if len(block) > 1 else self._last_s
        if math.isfinite(before):
            self._period_s = float(block.time_s[-1]) - before
        self._last_s = float(block.time_s[-1])
        return segments

    def _tick_of(self, time_s: float) -> int:
        assert self.start_s is not None
        return math.floor((time_s - self.start_s) / TICK_S + 1e-6)

    def _bounds(self, time_s: F64) -> list[int]:
        """Where ticks begin among increasing times; 0 first and the number of samples last."""
        n = len(time_s)
        first, last = self._tick_of(float(time_s[0])), self._tick_of(float(time_s[-1]))
        if last - first > 1:
            assert self.start_s is not None
            ticks = np.floor((time_s - self.start_s) / TICK_S + 1e-6)
            return [0, *(np.flatnonzero(ticks[1:] != ticks[:-1]) + 1).tolist(), n]
        if last > first:  # the usual cases: a block of about a tick, or of less
            return [0, bisect_left(time_s, last, key=self._tick_of), n]
        return [0, n]

    def _increasing(self, block: SampleBlock) -> Iterator[SampleBlock]:
        """The block in parts of strictly increasing time, as it should be in one. A sample with the time of the one
        before it is the same sample again: the first is kept, the others are counted."""
        time_s = block.time_s
        if len(block) == 0:
            return
        first, last = float(time_s[0]), float(time_s[-1])
        if first > self._raw_last_s and block.steps_s[0] > 0.0 and math.isfinite(last):
            yield block
        else:
            before = np.concatenate([[self._raw_last_s], time_s[:-1]])
            keep = np.isfinite(time_s) & (time_s != before)
            self.repeated += len(block) - int(np.count_nonzero(keep))
            block = block.select(keep)
            back = np.flatnonzero(np.diff(block.time_s) <= 0.0) + 1
            for a, b in pairwise([0, *back.tolist(), len(block)]):
                if b > a:
                    yield block.slice(a, b)
        if len(block):
            self._raw_last_s = float(block.time_s[-1])

    def _continued(self, block: SampleBlock) -> SampleBlock:
        """Shift a block whose device time is behind the stream's, as after a restart the driver did not notice."""
        time_s = block.time_s + self._offset_s if self._offset_s else block.time_s
        if time_s[0] > self._last_s:
            return block if time_s is block.time_s else replace(block, time_s=time_s)
        shift = self._last_s + self._period_s - float(time_s[0])
        self._offset_s += shift
        quality = block.quality.copy()
        quality[0] |= Quality.TIME_RESTART
        return replace(block, time_s=time_s + shift, quality=quality)
