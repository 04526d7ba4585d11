"""Counters that wrap, and receive times on a clock that is set: both made continuous, block by block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.can.decode import Bits, FrameBatch
from servo_daemon.samples import F64

#: A step of the host's wall clock smaller than this is left alone: NTP slews, it rarely steps by less.
CLOCK_STEP_S = 0.05
#: Receive times are at least so far apart; several frames may carry one stamp.
MIN_STEP_S = 1e-6

#: Device time that seems to have passed so much faster than the host's did not pass: the device restarted.
CLOCK_RATIO, CLOCK_SLACK_S = 1.1, 0.5


class WrappedPosition:
    """A position modulo `wrap` (in its own unit), continued over it by going the shorter way round each time."""

    def __init__(self, wrap: float) -> None:
        self._wrap = wrap
        self._last: float | None = None
        self._turns = 0.0

    def unwrap(self, value: F64) -> F64:
        """The next values, shape (n,). Turns are counted, so no rounding adds up; what is not finite stays so."""
        known = np.isfinite(value)
        if not known.any():
            return value
        finite = value[known]
        step = np.diff(finite, prepend=finite[0] if self._last is None else self._last)
        turns = self._turns - np.cumsum(np.rint(step / self._wrap))
        self._last, self._turns = float(finite[-1]), float(turns[-1])
        continued = value.copy()
        continued[known] += self._wrap * turns
        return continued

    def restart(self) -> None:
        """Start anew with the next value."""
        self._last, self._turns = None, 0.0


class DeviceTime:
    """A device's own time, modulo `wrap` seconds (None: it does not wrap), made continuous; finds restarts."""

    def __init__(self, wrap: float | None) -> None:
        self._wrap = wrap
        self._last: tuple[float, float] | None = None  # device time, receive time
        self._turns = 0

    def fresh(self, time_s: F64) -> Bits:
        """Which of the next values are a time and not that of the sample before again, shape (n,)."""
        finite = np.isfinite(time_s)
        known = np.where(finite, time_s, 0.0)
        before = np.concatenate([[np.nan if self._last is None else self._last[0]], known[:-1]])
        changed: Bits = known != before
        return finite & changed

    def unwrap(self, time_s: F64, received_s: F64) -> tuple[F64, Bits]:
        """Continuous time and where the device restarted, both shape (n,); the values are finite, n >= 1.

        Time falls only where the device restarted, and goes on from its new time there.
        """
        last_s, last_received_s = self._last or (float(time_s[0]), float(received_s[0]))
        back = np.diff(time_s, prepend=last_s) < 0
        restart = back.copy()
        if self._wrap is not None:
            passed_s = np.diff(received_s, prepend=last_received_s)
            wrapped_step = np.diff(time_s, prepend=last_s) % self._wrap
            restart &= wrapped_step > CLOCK_RATIO * np.maximum(passed_s, 0.0) + CLOCK_SLACK_S
        turns = self._turns + np.cumsum(back & ~restart)
        at_restart = np.flatnonzero(restart)
        for row in at_restart:
            turns[row:] -= turns[row]
        self._last, self._turns = (float(time_s[-1]), float(received_s[-1])), int(turns[-1])
        return time_s + (self._wrap or 0.0) * turns, restart


@dataclass(frozen=True, slots=True)
class _Seen:
    stamp_s: float
    lag_s: float
    wall_minus_monotonic_s: float


class ReceiveClock:
    """python-can's receive time stamps without the steps of the host's wall clock.

    Many interfaces stamp frames with the wall clock, which may be set while we run; others have a clock of their own.
    A step is believed when the wall clock stepped against the monotonic one and the stamps went with it.
    """

    def __init__(self) -> None:
        self._seen: _Seen | None = None
        self._correction_s = 0.0
        self._origin_s = 0.0

    def continuous(self, batch: FrameBatch) -> tuple[F64, Bits]:
        """Time since the first frame, shape (n,), s, and where a step was taken out, shape (n,)."""
        stepped = np.zeros(len(batch), np.bool_)
        correction = np.full(len(batch), self._correction_s)
        now = _Seen(float(batch.stamp_s[-1]), batch.host_s - float(batch.stamp_s[-1]), batch.wall_s - batch.host_s)
        if self._seen is None:
            self._origin_s = float(batch.stamp_s[0])
        else:
            step_s = now.wall_minus_monotonic_s - self._seen.wall_minus_monotonic_s
            followed_s = self._seen.lag_s - now.lag_s
            if abs(step_s) > CLOCK_STEP_S and abs(followed_s - step_s) < 0.5 * abs(step_s):
                jumps = np.diff(batch.stamp_s, prepend=self._seen.stamp_s)
                place = int(np.argmax(jumps) if step_s > 0 else np.argmin(jumps))
                correction[place:] -= step_s
                stepped[place] = True
                self._correction_s -= step_s
        self._seen = now
        return batch.stamp_s - self._origin_s + correction, stepped


def strictly_increasing(stamp_s: F64, last_s: float) -> F64:
    """Times at least `MIN_STEP_S` apart and after `last_s`, none before its stamp. Shape (n,)."""
    if (np.diff(stamp_s, prepend=last_s) >= MIN_STEP_S).all():
        return stamp_s
    ramp = MIN_STEP_S * np.arange(1, len(stamp_s) + 1)
    return np.asarray(np.maximum(np.maximum.accumulate(stamp_s - ramp), last_s) + ramp, np.float64)
