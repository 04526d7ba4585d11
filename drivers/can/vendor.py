"""Another maker's drive: frames of several messages, at rates of their own, combined into samples by a signal map.

Each arrival of the trigger message (the one that carries the position) makes a sample; every other signal has the
value it last had (zero-order hold), and counts as invalid once that is older than its staleness bound. Time comes from
the mapped device time, else from python-can's receive time stamps, freed of steps of the host's clock and, where the
sample period is known, of their jitter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from drivers.base import DriveInfo, DriverCounters
from drivers.can.cadence import Cadence
from drivers.can.decode import Bits, Field, FrameBatch, key_text
from drivers.can.map import COUNTS, SEQUENCE, TIME, MappedChannel, SignalMap
from drivers.can.unwrap import DeviceTime, ReceiveClock, WrappedPosition, strictly_increasing
from servo_daemon.samples import CHANNELS, F64, I64, U8, Quality, SampleBlock

#: A signal not heard for longer is no measurement of now, unless the map gives it a bound of its own. Slow ones
#: (temperature) have none by default.
STALE_S = 0.1
#: Without a sample period, a silence this long is reported as a gap.
GAP_S = 0.1
#: With one, a step of this many periods is.
GAP_PERIODS = 1.5

_INVALID = {
    "voltage_V": Quality.VOLTAGE_INVALID,
    "current_A": Quality.CURRENT_INVALID,
    "position_rad": Quality.POSITION_INVALID,
    COUNTS: Quality.POSITION_INVALID,
}
_SLOW = ("temperature_C",)

#: A counter this long that goes back has started anew; a shorter one may just as well have lost frames.
_LONG_COUNTER = 65_536
#: More samples than this are not missing: the time is nonsense.
_MOST_LOST = 2**31


@dataclass(slots=True)
class _Held:
    """The last value of a signal and when it came."""

    value: float = math.nan
    stamp_s: float = -math.inf


@dataclass(frozen=True, slots=True)
class _Heard:
    """One signal in a batch: frame numbers in it, and values."""

    at: I64
    values: F64


class VendorDecoder:
    """The frames of one drive that needs a signal map.

    Args:
        signals: the map.
        counters: counted up here.
        counts_per_rev: turns `position_counts` into radians; negative turns the direction round.
        period_s: sample period of the trigger message, where it is known: losses can then be counted, and the jitter
            of receive time stamps taken out where there is no device time.
        stale_s: staleness bound of signals without one of their own.
    """

    def __init__(
        self,
        signals: SignalMap,
        counters: DriverCounters,
        *,
        counts_per_rev: float | None = None,
        period_s: float | None = None,
        stale_s: float = STALE_S,
    ) -> None:
        self._map, self._counters = signals, counters
        self._counts_per_rev, self._period_s, self._stale_s = counts_per_rev, period_s, stale_s
        self._channels = tuple(c for c in signals.channels if c.name in (*CHANNELS, COUNTS))
        self._time, self._count = signals.get(TIME), signals.get(SEQUENCE)
        self._even, self._anew = True, False
        self.reset()

    @property
    def trigger(self) -> Field:
        """The signal whose message makes a sample."""
        return self._map.trigger

    @property
    def dates_by_stamps(self) -> bool:
        """Whether the drive sends no time of its own."""
        return self._time is None

    @property
    def off_pace(self) -> bool:
        """Samples come at another rate than `period_s`: their times are wrong."""
        return self._cadence is not None and self._cadence.is_off

    def begin_anew(self) -> None:
        """The next sample's time has nothing to do with that of the samples before it."""
        self._anew = True

    def take_pace(self, period_s: float | None, *, even: bool) -> None:
        """Begin with another period; even: samples are so far apart, whatever their stamps say."""
        self._period_s, self._even = period_s, even
        self.reset()

    @property
    def keys(self) -> frozenset[int]:
        """The identifiers this decoder wants."""
        return frozenset(f.key for f in self._map.fields)

    @property
    def info(self) -> DriveInfo:
        """What the map says of the device. The maker's protocol has no serial number we know of."""
        channels = {_as_channel(c.name) for c in self._channels}
        return DriveInfo(
            identity=f"can:{self._map.trigger.name}:{key_text(self._map.trigger.key)}",
            sample_period_s=self._period_s,
            counts_per_rev=abs(self._counts_per_rev or 0.0) or None,
            channels=tuple(c for c in CHANNELS if c in channels),
        )

    def reset(self) -> None:
        """Forget everything: the next frames may be another device's."""
        self._clock = ReceiveClock()
        self._held = {f.name: _Held() for f in self._map.fields}
        self._positions = {c.name: WrappedPosition(c.wrap) for c in self._channels if c.wrap is not None}
        self._device_time = DeviceTime(self._time.wrap) if self._time is not None else None
        even = self._time is None and self._period_s is not None and self._even
        self._cadence = Cadence(self._period_s) if even and self._period_s is not None else None
        self._last_time_s: float | None = None
        self._last_count: float | None = None
        self._last_number = -1

    def feed(self, batch: FrameBatch) -> list[SampleBlock]:
        """Samples that these frames make: one block, more where the device restarted, none without the trigger.

        Frames with other identifiers are ignored; frames too short for their message are counted in
        `framing_errors`.
        """
        with np.errstate(all="ignore"):  # signals may carry anything; what is not finite is flagged below
            return self._feed(batch)

    def _feed(self, batch: FrameBatch) -> list[SampleBlock]:
        stamp_s, stepped = self._clock.continuous(batch)
        heard = self._hear(batch)
        at = heard[self._map.trigger.name].at
        blocks: list[SampleBlock] = []
        if len(at):
            jumped = np.diff(np.cumsum(stepped)[at], prepend=0) > 0
            at, jumped = self._fresh(heard, at, jumped)
        if len(at):
            blocks = self._samples(heard, at, stamp_s, jumped, batch.host_s)
        for name, one in heard.items():
            if len(one.at):
                self._held[name] = _Held(float(one.values[-1]), float(stamp_s[one.at[-1]]))
        return blocks

    def _hear(self, batch: FrameBatch) -> dict[str, _Heard]:
        """Every mapped signal in the frames."""
        heard: dict[str, _Heard] = {}
        frames: dict[int, I64] = {}
        for field in self._map.fields:
            if field.key not in frames:
                mine = batch.keys == field.key
                long_enough = mine & (batch.lengths >= field.message_bytes)
                frames[field.key] = np.flatnonzero(long_enough)
                self._counters.frames += len(frames[field.key])
                self._counters.framing_errors += int(np.count_nonzero(mine)) - len(frames[field.key])
            heard[field.name] = _read(field, frames[field.key], batch.data)
        return heard

    def _fresh(self, heard: dict[str, _Heard], at: I64, jumped: Bits) -> tuple[I64, Bits]:
        """Trigger frames without those that repeat the one before (by its number or time)."""
        fresh = np.ones(len(at), np.bool_)
        if self._count is not None:
            count, _ = self._combined(self._count, heard, at, None)
            fresh &= np.diff(count, prepend=np.nan if self._last_count is None else self._last_count) != 0
        if self._time is not None and self._device_time is not None:
            fresh &= self._device_time.fresh(self._combined(self._time, heard, at, None)[0])
        self._counters.samples_repeated += int(np.count_nonzero(~fresh))
        return at[fresh], jumped[fresh]

    def _samples(
        self, heard: dict[str, _Heard], at: I64, stamp_s: F64, jumped: Bits, host_s: float
    ) -> list[SampleBlock]:
        """One sample for each of the trigger frames `at`."""
        quality = np.where(jumped, np.uint8(Quality.GAP_BEFORE), np.uint8(0))
        time_s, restart = self._times(heard, at, stamp_s)
        restart[0] |= self._anew
        self._anew = False
        sequence = self._numbers(heard, at, time_s, restart, quality)
        if self._cadence is not None:
            time_s = self._cadence.times(time_s, sequence)
        columns: dict[str, Any] = {}
        for channel in self._channels:
            value, invalid = self._combined(channel, heard, at, stamp_s)
            value[invalid] = np.nan
            quality[invalid] |= int(_INVALID.get(channel.name, Quality.GOOD))
            columns[_as_channel(channel.name)] = self._unwrapped(channel, value, restart)
        quality[restart] |= int(Quality.TIME_RESTART)
        self._counters.device_restarts += int(np.count_nonzero(restart))
        block = SampleBlock(time_s=time_s, sequence=sequence, quality=quality, host_time_s=host_s, **columns)
        edges = [0, *np.flatnonzero(restart).tolist(), len(at)]
        return [block.slice(a, b) for a, b in pairwise(edges) if a < b]

    def _combined(
        self, channel: MappedChannel, heard: dict[str, _Heard], at: I64, stamp_s: F64 | None
    ) -> tuple[F64, Bits]:
        """A channel's value at the trigger frames and where it is no measurement; without stamps, however old."""
        values: dict[str, F64] = {}
        invalid = np.zeros(len(at), np.bool_)
        for operand in channel.operands:
            one, held = heard[operand.field.name], self._held[operand.field.name]
            latest = np.searchsorted(one.at, at, side="right")
            value = np.concatenate([[held.value], one.values])[latest]
            values[operand.name] = value * operand.scale + operand.offset
            bound_s = operand.stale_s or (math.inf if channel.name in _SLOW else self._stale_s)
            if stamp_s is not None:
                came_s = np.concatenate([[held.stamp_s], stamp_s[one.at]])[latest]
                invalid |= stamp_s[at] - came_s > bound_s
        value = values[channel.operands[0].name] if channel.formula is None else channel.formula(values)
        return value, invalid | ~np.isfinite(value)

    def _times(self, heard: dict[str, _Heard], at: I64, stamp_s: F64) -> tuple[F64, Bits]:
        if self._time is not None and self._device_time is not None:
            return self._device_time.unwrap(self._combined(self._time, heard, at, None)[0], stamp_s[at])
        last_s = -math.inf if self._last_time_s is None else self._last_time_s
        return strictly_increasing(stamp_s[at], last_s), np.zeros(len(at), np.bool_)

    def _numbers(self, heard: dict[str, _Heard], at: I64, time_s: F64, restart: Bits, quality: U8) -> I64:
        """Running numbers, and GAP_BEFORE where some are missing or too much time passed."""
        step_s = np.diff(time_s, prepend=time_s[0] if self._last_time_s is None else self._last_time_s)
        gap_s = GAP_PERIODS * self._period_s if self._period_s is not None else GAP_S
        if self._time is None:
            gap_s = max(gap_s, GAP_S)  # a late receive time stamp is no gap
        late = (step_s > gap_s) & ~restart
        steps = np.ones(len(at), np.int64)
        if self._count is not None:
            steps = self._counted(heard, at, restart)
        elif self._period_s is not None:
            steps[late] = np.clip(np.rint(step_s[late] / self._period_s), 1, _MOST_LOST).astype(np.int64)
        quality[late | (steps > 1)] |= int(Quality.GAP_BEFORE)
        self._counters.samples_lost += int(steps.sum()) - len(at)
        number = self._last_number + np.cumsum(steps)
        self._last_time_s, self._last_number = float(time_s[-1]), int(number[-1])
        return number

    def _counted(self, heard: dict[str, _Heard], at: I64, restart: Bits) -> I64:
        """Steps of the drive's own running number; 1 where it started anew."""
        assert self._count is not None
        count, _ = self._combined(self._count, heard, at, None)
        step = np.diff(count, prepend=count[0] - 1 if self._last_count is None else self._last_count)
        self._last_count = float(count[-1])
        wrap = self._count.wrap
        anew = restart | (step < 0)
        if wrap is not None:
            step %= wrap
            anew = restart | ((step > wrap / 2) & (wrap >= _LONG_COUNTER))
        return np.where(anew | ~np.isfinite(step), 1, np.maximum(1, np.rint(step))).astype(np.int64)

    def _unwrapped(self, channel: MappedChannel, value: F64, restart: Bits) -> F64:
        """The value in the unit of its channel, continued over its wraps."""
        position = self._positions.get(channel.name)
        if position is not None:
            edges = [0, *np.flatnonzero(restart).tolist(), len(value)]
            parts = []
            for a, b in pairwise(edges):
                if a < len(value) and restart[a]:
                    position.restart()
                parts.append(position.unwrap(value[a:b]))
            value = np.concatenate(parts)
        if channel.name == COUNTS and self._counts_per_rev is not None:
            value = value * (2 * math.pi / self._counts_per_rev)
        return value


def _as_channel(name: str) -> str:
    return "position_rad" if name == COUNTS else name


def _read(field: Field, frames: I64, data: U8) -> _Heard:
    """One signal out of the frames of its message; those in which a multiplexer leaves it out are passed over."""
    if not len(frames):
        return _Heard(frames, np.empty(0))
    mine = data[frames]
    if field.selected_by:
        there = field.present(mine)
        frames, mine = frames[there], mine[there]
    return _Heard(frames, field.physical(mine))
