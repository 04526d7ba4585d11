"""When a drive took the values of a poll, where it sends no time: the host only knows when it asked and was answered.

Between those two moments the drive took them. Where they lie far apart (a busy host, USB's milliseconds), the way that
the shaft went since the poll before, at the mean of the two speeds, tells how much time passed for the drive.
"""

from __future__ import annotations

import math

import numpy as np

from servo_daemon.samples import F64

#: Slower than so many rad/s the speed's own steps and noise tell less of the time than the host does.
_SLOWEST_RAD_S = 3.0
#: Speeds this far apart, as a share of their mean, have no mean that holds in between.
_MOST_CHANGE = 0.5
#: Samples are at least so far apart, s: a control cycle.
_MIN_STEP_S = 5e-5
#: Rounds are at least so far apart, s.
_SHORTEST_ROUND_S = 1e-4


class SampleTimes:
    """Times of one drive's polls."""

    def __init__(self) -> None:
        self._last: tuple[float, float, float, float] | None = None  # time, request, angle, speed

    def restart(self) -> None:
        """The next values may be another motor's."""
        self._last = None

    def times(self, sent_s: F64, received_s: F64, angle_rad: F64, speed_rad_s: F64 | None) -> F64:
        """Times of the next samples on the host's clock, shapes (n,), increasing; never outside request and answer
        but for that.

        Args:
            speed_rad_s: of the shaft, with the angle's sign; None: not known.
        """
        speeds = np.full(len(sent_s), math.nan) if speed_rad_s is None else speed_rad_s
        rows = zip(sent_s.tolist(), received_s.tolist(), angle_rad.tolist(), speeds.tolist(), strict=True)
        return np.array([self._next(*row) for row in rows])

    def _next(self, sent_s: float, received_s: float, angle: float, speed: float) -> float:
        time_s = sent_s
        if self._last is not None:
            last_s, last_sent_s, last_angle, last_speed = self._last
            mean = 0.5 * (speed + last_speed)
            step_s = sent_s - last_sent_s
            if abs(mean) > _SLOWEST_RAD_S and abs(speed - last_speed) < _MOST_CHANGE * abs(mean):
                step_s = (angle - last_angle) / mean
            time_s = max(last_s + _MIN_STEP_S, min(received_s, max(sent_s, last_s + step_s)))
        self._last = (time_s, sent_s, angle, speed)
        return time_s


class OneMoment:
    """Takes what a round reads one after another to one moment, by how it has changed since the round before.

    Attributes:
        trip_s: the shortest round trip, what the wire and the drive take; infinite before the first. Longer ones waited
            for the host, and tell nothing of when the values were taken.
    """

    def __init__(self) -> None:
        self.trip_s = math.inf
        self._last: tuple[F64, F64] | None = None  # when the last round was asked for, its values

    def restart(self) -> None:
        """The next round does not follow on the last one."""
        self._last = None

    def moved(self, values: F64, sent_s: F64, received_s: F64, by: F64) -> F64:
        """Values so much later.

        Args:
            values: shape (n, m), n ≥ 1 rounds of m values; NaN: not known.
            sent_s, received_s: shape (n,), of the rounds.
            by: shape (m,), shares of the shortest trip.
        """
        self.trip_s = min(self.trip_s, float(np.min(received_s - sent_s)))
        before_s, before = (sent_s[:1], values[:1]) if self._last is None else self._last
        self._last = sent_s[-1:], values[-1:]
        apart_s = np.maximum(np.diff(sent_s, prepend=before_s), _SHORTEST_ROUND_S)
        change = np.diff(values, axis=0, prepend=before) / apart_s[:, None]
        change[~np.isfinite(change)] = 0.0
        return np.asarray(values + change * (self.trip_s * by))
