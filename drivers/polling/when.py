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


class ShortestTrip:
    """Of a drive's round trips the shortest one: what the wire and the drive take. Longer ones waited for the host, and
    tell nothing of when the values were taken.

    Attributes:
        value_s: infinite before the first.
    """

    def __init__(self) -> None:
        self.value_s = math.inf

    def after(self, sent_s: F64, received_s: F64) -> float:
        """Seconds, with these trips too, shapes (n,), n ≥ 1."""
        self.value_s = min(self.value_s, float(np.min(received_s - sent_s)))
        return self.value_s
