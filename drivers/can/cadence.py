"""Times of samples that are taken at a steady rate, out of receive times that are not."""

from __future__ import annotations

import numpy as np

from drivers.can.unwrap import strictly_increasing
from servo_daemon.samples import F64, I64

#: Samples over which the jitter of receive times is averaged.
SMOOTHING = 500
#: Samples come at another rate than thought where, over so long (s), they are off by this share of it and by as much
#: as a host may stall without a gap (0.1 s) as well. Looked at anew from this age on, s.
_LEAST_S, _SHARE, _STALL_S, _ANEW_S = 0.5, 0.05, 0.12, 3.0


class Cadence:
    """Times of samples that are taken every `period_s` but only known by when they were received.

    A USB adapter delivers in bunches: the stamps of a 1 kHz drive may be 0.05 ms or 8 ms apart. Here the deviation of
    the stamps from the steady cadence is averaged over `SMOOTHING` samples, so that one sample follows the other by a
    period to within a 500th of the jitter, and a period that is slightly wrong is followed.
    """

    def __init__(self, period_s: float) -> None:
        from scipy.signal import lfilter  # late: few drives need it, and it takes a third of a second to import

        self._lfilter = lfilter
        self._period_s = period_s
        self._deviation_s: float | None = None
        self._last_s = -np.inf
        self._since: tuple[float, int] | None = None  # received, number
        self.is_off = False

    def times(self, received_s: F64, number: I64) -> F64:
        """Times of the next samples, shape (n,), strictly increasing.

        Args:
            received_s: when they were received.
            number: running number of each.
        """
        nominal = number * self._period_s
        deviation = received_s - nominal
        before = float(deviation[0]) if self._deviation_s is None else self._deviation_s
        gain = 1 / SMOOTHING
        smooth, _ = self._lfilter([gain], [1.0, gain - 1.0], deviation, zi=[(1.0 - gain) * before])
        time_s = strictly_increasing(nominal + smooth, self._last_s)
        self._deviation_s, self._last_s = float(smooth[-1]), float(time_s[-1])
        self._check(float(received_s[-1]), int(number[-1]))
        return time_s

    def _check(self, received_s: float, number: int) -> None:
        """Whether so many samples take as long as they should."""
        if self._since is None:
            self._since = received_s, number
            return
        span_s = received_s - self._since[0]
        off_s = abs(span_s - (number - self._since[1]) * self._period_s)
        if span_s >= _LEAST_S:
            self.is_off = self.is_off or off_s > _SHARE * span_s + _STALL_S
        if span_s >= _ANEW_S:
            self._since = received_s, number
