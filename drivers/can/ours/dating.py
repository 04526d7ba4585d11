"""Continuous time, position and numbering out of the 16-bit fields of our own CAN frames.

Samples carry the low 16 bits of device time (µs) and position (counts). A Sync makes the sample after it an *anchor*:
a row whose whole time, position and running number are known. Differences modulo 2^16 lead from one sample to the
next; an anchor corrects where they led astray, which only a gap of more than `STALE_US` or a restart can do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.base import DriverCounters
from servo_daemon.samples import I64, U8, Quality

U16 = NDArray[np.uint16]

#: A step of the 16-bit time into the last 8 ms of its range is an older sample seen again, not 57 ms of silence.
STALE_US = 65_536 - 8_192
#: When the newest sample known is older than this, what comes next may lie beyond such a gap (7 ms of margin).
DOUBT_S = 0.05
#: An anchor this much later than the host thinks possible is not later: the device restarted.
FUTURE_SLACK_S = 0.2
#: How fast host clock - device clock is allowed to change: more than two cheap crystals ever drift apart.
CLOCK_DRIFT = 0.01

_16, _32 = 1 << 16, 1 << 32
#: Plain integers: NumPy widens a uint8 array for an IntFlag.
_GAP, _RESTART = int(Quality.GAP_BEFORE), int(Quality.TIME_RESTART)


def differences(values: U16, before: int) -> U16:
    """Each value minus the one before it modulo 2^16, shape (n,), n >= 1. (`np.diff` takes eight times as long.)"""
    out = np.empty_like(values)
    out[0] = (int(values[0]) - before) & 0xFFFF
    np.subtract(values[1:], values[:-1], out=out[1:])
    return out


def signed(value: int, bits: int) -> int:
    """`value` modulo 2^bits as a signed number."""
    half = 1 << (bits - 1)
    return (value + half) % (1 << bits) - half


@dataclass(frozen=True, slots=True)
class Anchor:
    """What a Sync says of the sample in row `row`: time in µs (32 bits), running number (16), position (32, signed)."""

    row: int
    time_us: int
    count: int
    position: int


@dataclass(frozen=True, slots=True)
class Dated:
    """Samples with their place in time, shapes (n,).

    Attributes:
        rows: which of the rows given are left; repeated ones are not.
        time_us, position, sequence: continuous; time falls only where `quality` says TIME_RESTART.
        quality: GAP_BEFORE and TIME_RESTART bits.
    """

    rows: I64
    time_us: I64
    position: I64
    sequence: I64
    quality: U8


class Last(NamedTuple):
    """The last sample dated, and how far its clock is behind the host's (the least seen: transport only adds).

    Attributes:
        count_offset: `sequence` minus the running number the device gave it, modulo 2^16.
    """

    time_us: int
    position: int
    sequence: int
    count_offset: int
    host_s: float
    lag_s: float

    def drift_s(self, host_s: float) -> float:
        """How much the lag may have changed since."""
        return CLOCK_DRIFT * max(0.0, host_s - self.host_s)


_EMPTY: I64 = np.empty(0, np.int64)
_NOTHING = Dated(_EMPTY, _EMPTY, _EMPTY, _EMPTY, np.empty(0, np.uint8))


class Timeline:
    """The place of one drive's samples in time. Counts losses, repetitions and restarts in `counters`."""

    def __init__(self, counters: DriverCounters) -> None:
        self._counters = counters
        self._last: Last | None = None
        self._count_offset = 0

    def doubtful(self, host_s: float) -> bool:
        """Whether samples arriving now need an anchor before they can be dated."""
        last = self._last
        return last is None or host_s - last.lag_s - last.time_us * 1e-6 > DOUBT_S

    def date(
        self, time16: U16, position16: U16, anchors: Sequence[Anchor], doubt: bool, host_s: float, period_s: float
    ) -> Dated:
        """Continue the time line with samples in the order of arrival.

        Args:
            time16, position16: shape (n,), n >= 1, low 16 bits.
            anchors: in the order of their rows; at least one if `doubt`.
            doubt: date the samples before the first anchor back from it instead of on from the last sample.
            host_s: monotonic host clock at their arrival.
            period_s: nominal sample period.
        """
        keep = self._fresh(time16, anchors, doubt)
        if len(keep) < len(time16):
            self._counters.samples_repeated += len(time16) - len(keep)
            anchors = _kept(anchors, keep, time16)
            time16, position16 = time16[keep], position16[keep]
        if not len(keep) or (self._last is None and not anchors):
            return _NOTHING
        return self._place(keep, time16, position16, anchors, doubt, host_s, period_s)

    @property
    def last(self) -> Last | None:
        return self._last

    def advance(self, time_us: int, position: int, sequence: int, host_s: float, restarted: bool = False) -> None:
        """Go on from this sample, the last that had arrived at `host_s`."""
        last = self._last
        lag_s = host_s - time_us * 1e-6
        if last is not None and not restarted:
            lag_s = min(lag_s, last.lag_s + last.drift_s(host_s))
        self._last = Last(time_us, position, sequence, self._count_offset, host_s, lag_s)

    def _fresh(self, time16: U16, anchors: Sequence[Anchor], doubt: bool) -> I64:
        """Rows that are no repetition of an earlier sample. Loops only where there seems to be one."""
        last_us = self._last.time_us if self._last is not None else int(time16[0]) - 1
        step = differences(time16, last_us)
        if doubt and step[0]:
            step[0] = 1  # how far a gap led is not to be judged modulo 2^16
        if step.min() > 0 and step.max() <= STALE_US:
            return np.arange(len(time16))
        whole_us = {a.row: a.time_us for a in anchors}
        known = self._last is not None
        kept = []
        for row, now in enumerate(time16.tolist()):
            ahead = (now - last_us) % _16
            fresh = 0 < ahead <= STALE_US or (ahead > 0 and doubt and row == 0)
            if row in whole_us and known:  # a device that restarted is not behind, whatever the low 16 bits say
                fresh = not STALE_US - _16 <= signed(whole_us[row] - last_us, 32) <= 0
            if fresh:
                kept.append(row)
                known |= row in whole_us
                last_us = whole_us.get(row, last_us + ahead)
        return np.array(kept, np.int64)

    def _place(
        self,
        keep: I64,
        time16: U16,
        position16: U16,
        anchors: Sequence[Anchor],
        doubt: bool,
        host_s: float,
        period_s: float,
    ) -> Dated:
        last = self._last or Last(int(time16[0]), int(position16[0]), 0, 0, host_s, 0.0)
        step_us = differences(time16, last.time_us).astype(np.int64)
        moved = differences(position16, last.position).view(np.int16).astype(np.int64)
        quality = np.zeros(len(time16), np.uint8)
        self._align(step_us, moved, quality, last, anchors, doubt, host_s)
        number = self._number(last, step_us, quality, anchors, doubt, period_s)
        dated = Dated(keep, last.time_us + step_us.cumsum(), last.position + moved.cumsum(), number, quality)
        restarted = bool((quality & _RESTART).any())
        self.advance(int(dated.time_us[-1]), int(dated.position[-1]), int(number[-1]), host_s, restarted)
        return dated

    def _align(
        self,
        step_us: I64,
        moved: I64,
        quality: U8,
        last: Last,
        anchors: Sequence[Anchor],
        doubt: bool,
        host_s: float,
    ) -> None:
        """Put the steps of time and position right so that they meet every anchor."""
        attaching = self._last is None
        latest_us = (host_s - last.lag_s + last.drift_s(host_s) + FUTURE_SLACK_S) * 1e6
        for k, anchor in enumerate(anchors):
            new = attaching and k == 0
            predicted_us = last.time_us + int(step_us[: anchor.row + 1].sum())
            ahead_us = (anchor.time_us - predicted_us) % _32
            too_late = not attaching and predicted_us + ahead_us > latest_us
            restart = not new and ahead_us > 0 and (too_late or ahead_us > _32 // 2)
            # A device that starts sends a Sync first, so what came before a restart is not of its new time.
            place = 0 if doubt and k == 0 and not restart else anchor.row
            if ahead_us or new:
                step_us[place] += anchor.time_us - predicted_us if restart or new else ahead_us
                quality[place] |= 0 if new else _RESTART if restart else _GAP
            predicted = last.position + int(moved[: anchor.row + 1].sum())
            off = anchor.position - predicted if restart or new else signed(anchor.position - predicted, 32)
            if off:
                moved[place] += off
                quality[place] |= 0 if restart or new else _GAP
            if restart:
                latest_us = np.inf  # the clocks have another offset from here on

    def _number(
        self, last: Last, step_us: I64, quality: U8, anchors: Sequence[Anchor], doubt: bool, period_s: float
    ) -> I64:
        """Running numbers: by time and period, put right by the count at each anchor."""
        steps = np.maximum(np.rint(step_us / (period_s * 1e6)), 1.0).astype(np.int64)
        new = self._last is None
        restarts = (quality & _RESTART) != 0
        steps[restarts] = 1
        if new:
            steps[0] = 0
        offset = last.count_offset
        for k, anchor in enumerate(anchors):
            place = 0 if doubt and k == 0 and not restarts[anchor.row] else anchor.row
            off = signed(anchor.count + offset - last.sequence - int(steps[: anchor.row + 1].sum()), 16)
            if not off:
                continue
            if new and k == 0:
                steps[0] += off % _16  # the first number is the device's own
            elif restarts[place]:
                offset -= off
            else:
                wanted = int(steps[place]) + off
                steps[place] = max(1, wanted)
                offset += int(steps[place]) - wanted
        self._count_offset = offset
        missing = steps > 1
        missing[0] &= not new
        if missing.any():
            quality[missing] |= _GAP
            self._counters.samples_lost += int((steps[missing] - 1).sum())
        self._counters.device_restarts += int(np.count_nonzero(restarts))
        return last.sequence + steps.cumsum()


def _kept(anchors: Sequence[Anchor], keep: I64, time16: U16) -> list[Anchor]:
    """The anchors by the rows that are left; that of a repeated sample goes to the sample it repeats."""
    moved = []
    for anchor in anchors:
        row = int(np.searchsorted(keep, anchor.row, side="right")) - 1
        if row >= 0 and time16[keep[row]] == time16[anchor.row]:
            moved.append(Anchor(row, anchor.time_us, anchor.count, anchor.position))
    return moved
