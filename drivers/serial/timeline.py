"""Numbers and times that wrap, made continuous: 32-bit sequence and microseconds, and the encoder's counter.

Frames arrive in order, but some are missing, some come twice, and now and then the device restarts. The timeline
decides for every frame which of these it is; the rules stand in `docs/protocol.md`. All state is integer, and every
decision depends on the frames alone, so the result is the same however the bytes were cut into reads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import I64, U8, Quality

#: The device counts microseconds in 32 bits (docs/protocol.md).
_WRAP = 1 << 32

#: A silence longer than this is taken for a restart: after a day the motor is another one anyhow, and a sequence
#: number that starts at random after a restart is not mistaken for a gap of weeks.
MAX_GAP_US = 86_400 * 1_000_000

#: A changed session whose numbering continues exactly, with at most this pause, is a changed description.
MAX_PAUSE_US = 1_000_000

#: The same of samples: a second at 20 kHz.
_MAX_MISSING = 20_000

#: A gap in which the device would have sampled this much faster than it does is no gap, but a new numbering.
_RATE_MARGIN = 4.0

#: Over a gap of several turns of the clock, time and numbering must agree to 5 % (an RC oscillator's error) and
#: 10 s; the turns are 71.6 minutes apart, so this leaves no doubt for gaps up to `MAX_GAP_US`.
_CLOCK_TOLERANCE = 0.05
_PAUSE_TOLERANCE_US = 10_000_000

#: Up to so many frames at once a loop over integers is cheaper than arrays.
_FEW = 8

#: Continuation after a restart when nothing is known of the sample period.
_UNKNOWN_PERIOD_US = 1_000


def _goes_on(raw_next: int, last_us: int, raw_number: int, raw_us: int) -> bool:
    """Whether a frame follows on a line, with few samples missing, within a moment. All as the device counts."""
    return 0 <= signed32(raw_number - raw_next) <= _MAX_MISSING and 0 < signed32(raw_us - last_us) <= MAX_PAUSE_US


def signed32(value: int) -> int:
    """The difference of two 32-bit counters as the nearer of its two meanings."""
    return ((value + 0x80000000) & 0xFFFFFFFF) - 0x80000000


@dataclass(frozen=True, slots=True)
class Placement:
    """Where frames came to lie.

    Attributes:
        kept: shape (frames,), False for frames that repeat an earlier one; None: all are kept.
        time_us: shape (kept,), unwrapped time of each frame's first sample.
        sequence: shape (kept,), unwrapped number of each frame's first sample.
        flags: shape (kept,), `Quality` bits of each frame's first sample; None: all good.
        undecided: so many of the last frames are not placed: what comes next tells whether they begin a restart. They
            are to be given again, first, with the frames that follow.
    """

    kept: NDArray[np.bool_] | None
    time_us: I64
    sequence: I64
    flags: U8 | None
    undecided: int = 0


class Timeline:
    """Sequence and time of one device, continuous over wraps, gaps and restarts.

    Attributes:
        lost, repeated, restarts: totals; `repeated` counts frames.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self.restarts = 0
        self._started = False
        self._new_session = False
        self._nominal_us: float | None = None
        self._measured_us = _UNKNOWN_PERIOD_US  # between the samples of the last frame
        self._raw_next = 0  # number the next sample should have, as the device counts
        self._raw_us = 0  # device time of the last sample, as the device counts
        self._next = 0  # the same two, unwrapped
        self._us = 0
        self._left: tuple[int, int] | None = None  # the first two as they were before the last restart

    def set_period(self, period_us: float | None) -> None:
        """The nominal sample period; None where sampling is not regular."""
        self._nominal_us = period_us

    def new_session(self) -> None:
        """The device says it started anew: unless its numbers go on exactly, the next frame is a restart."""
        self._new_session = self._started

    def place(
        self, sequence: NDArray[np.uint32], first_us: NDArray[np.uint32], span_us: I64, n: int,
        is_repeat: Callable[[int], bool], *, last: bool = False,
    ) -> Placement:  # fmt: skip
        """Place frames of `n` samples each, given in the order of arrival.

        Args:
            sequence: shape (frames,), number of each frame's first sample.
            first_us: shape (frames,), device time of each frame.
            span_us: shape (frames,), from that to its last sample.
            is_repeat: whether frame k has the very bytes of a recent earlier one.
            last: no more frames of this kind follow, so that all are placed.
        """
        if sequence.shape[0] > _FEW and self._started and not self._new_session:
            steps = self._steps(first_us, span_us)
            expected = np.arange(self._raw_next, self._raw_next + n * steps.shape[0], n, dtype=np.int64)
            if bool((steps > 0).all()) and bool((sequence == expected.astype(np.uint32)).all()):
                return self._place_regular(int(sequence[-1]), int(first_us[-1]), steps, span_us, n)
        return self._place_one_by_one(sequence.tolist(), first_us.tolist(), span_us.tolist(), n, is_repeat, last)

    def _steps(self, first_us: NDArray[np.uint32], span_us: I64) -> NDArray[np.int32]:
        """µs from the last sample before each frame to its first, as the nearer of the two meanings."""
        steps = first_us.copy()
        steps[1:] -= first_us[:-1] + span_us[:-1].astype(np.uint32)
        steps[:1] -= np.uint32(self._raw_us)
        return steps.view(np.int32)

    def _place_regular(
        self, last_number: int, last_us: int, steps: NDArray[np.int32], span_us: I64, n: int
    ) -> Placement:
        """Nothing lost, nothing twice: a sum instead of a loop."""
        time_us = np.cumsum(steps, dtype=np.int64)
        time_us[1:] += np.cumsum(span_us[:-1])
        time_us += self._us
        numbers = np.arange(self._next, self._next + n * steps.shape[0], n, dtype=np.int64)
        self._us = int(time_us[-2] + span_us[-2])  # a period may be measured from the last frame but one
        self._commit(last_number, last_us, int(span_us[-1]), n, int(time_us[-1]), int(numbers[-1]))
        return Placement(None, time_us, numbers, None)

    def _place_one_by_one(
        self,
        sequence: list[int],
        first_us: list[int],
        span_us: list[int],
        n: int,
        is_repeat: Callable[[int], bool],
        last: bool,
    ) -> Placement:
        kept, times, numbers, flags = [], [], [], []
        for k, (raw_number, raw_us, span) in enumerate(zip(sequence, first_us, span_us, strict=True)):
            ahead = signed32(raw_number - self._raw_next)
            keep = not (self._started and ahead < 0 and is_repeat(k))
            if keep and not self._new_session and self._is_restart(ahead, raw_us):
                if k + 1 < len(sequence):
                    keep = self._is_believed(raw_number + n, raw_us + span, sequence[k + 1], first_us[k + 1])
                elif not last:
                    break
            kept.append(keep)
            if keep:
                us, number, flag = self._place_one(ahead, raw_number, raw_us)
                self._commit(raw_number, raw_us, span, n, us, number)
                times.append(us)
                numbers.append(number)
                flags.append(flag)
            else:
                self.repeated += 1
        return Placement(
            None if all(kept) else np.array(kept),
            np.array(times, dtype=np.int64),
            np.array(numbers, dtype=np.int64),
            np.array(flags, dtype=np.uint8) if any(flags) else None,
            len(sequence) - len(kept),
        )

    def _is_restart(self, ahead: int, raw_us: int) -> bool:
        """Whether a frame lies on neither the line of those before it nor the one that the last restart left."""
        on_the_line = self._elapsed(ahead, signed32(raw_us - self._raw_us)) is not None
        return self._started and not on_the_line

    def _is_believed(self, raw_next: int, raw_us: int, number: int, us: int) -> bool:
        """Whether a restart is one, by the frame that follows its first. An old frame that comes once more (a line that
        repeats, a device that answers from a buffer) is none.

        Args:
            raw_next, raw_us: what would follow, and the time before it.
            number, us: what does follow.
        """
        return _goes_on(raw_next, raw_us, number, us) and not _goes_on(self._raw_next, self._raw_us, number, us)

    def _place_one(self, ahead: int, raw_number: int, raw_us: int) -> tuple[int, int, int]:
        """Unwrapped time and number, and flags, of a frame that is no repetition."""
        if not self._started:
            return raw_us, raw_number, 0
        elapsed = self._elapsed(ahead, signed32(raw_us - self._raw_us))
        left = self._left
        back = left is not None and ahead != 0 and not self._new_session and _goes_on(*left, raw_number, raw_us)
        if elapsed is None or back:
            # Back on the line that was left, there was no restart, and nothing is lost.
            self.restarts += not back
            self._left = None if back or self._new_session else (self._raw_next, self._raw_us)
            period_us = max(1, round(self._nominal_us or self._measured_us))
            return self._us + period_us, self._next, int(Quality.TIME_RESTART)
        self.lost += ahead
        return self._us + elapsed, self._next + ahead, int(Quality.GAP_BEFORE) if ahead else 0

    def _elapsed(self, ahead: int, step_us: int) -> int | None:
        """µs since the last sample, or None when the device must have restarted.

        Args:
            ahead: samples missing before this frame by its number.
            step_us: the time step as the nearer of its meanings; more turns of the clock may have passed.
        """
        if ahead < 0 or (self._new_session and not (ahead == 0 and 0 < step_us <= MAX_PAUSE_US)):
            return None
        if ahead == 0 or self._nominal_us is None:
            return step_us if step_us > 0 else None
        expected = (ahead + 1) * self._nominal_us
        turns = round((expected - step_us) / _WRAP)
        elapsed = step_us + turns * _WRAP
        too_many = (ahead + 1) * min(self._nominal_us, self._measured_us) > _RATE_MARGIN * elapsed
        wrong_turn = turns != 0 and abs(elapsed - expected) > _CLOCK_TOLERANCE * expected + _PAUSE_TOLERANCE_US
        return elapsed if 0 < elapsed <= MAX_GAP_US and not (too_many or wrong_turn) else None

    def _commit(self, raw_number: int, raw_us: int, span_us: int, n: int, us: int, number: int) -> None:
        """Take note of a placed frame (in the regular case the last of many): its raw and its unwrapped start."""
        if n > 1:
            self._measured_us = max(1, span_us // (n - 1))
        elif self._started:
            self._measured_us = max(1, us - self._us)
        self._raw_next = (raw_number + n) & 0xFFFFFFFF
        self._raw_us = (raw_us + span_us) & 0xFFFFFFFF
        self._next, self._us = number + n, us + span_us
        self._started, self._new_session = True, False
