"""Times of samples that carry none: from when they arrived, with the jitter of the arrival taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servo_daemon.samples import Quality, SampleBlock, concatenate

#: So long, s, is listened before the period counts as measured. At 100 Hz and 40 ms from read to read that leaves
#: about 0.5 % of error, which the loop then takes out.
MEASURE_S = 1.0
#: And at least so many reads with samples.
MEASURE_READS = 8
#: So much more than a second of samples waits for the period at most: a line of 10 kHz.
_MOST_WAITING = 20_000
#: Samples over which the jitter of arrivals is averaged, as on a CAN bus (`drivers/can/unwrap.py`).
SMOOTHING = 500
#: A delay of more than so many periods, and longer than this, is no jitter: samples are missing.
GAP_PERIODS, GAP_S = 10.0, 0.25


class ArrivalClock:
    """Dates blocks whose `time_s` means nothing by their `sequence` and `host_time_s`, with a phase-locked loop of
    second order (critically damped). Until the period is known, told or by listening for `MEASURE_S`, blocks wait.

    Args:
        period_s: of the device, s, where it is known.

    Attributes:
        period_s: as told or measured; None: not yet.
        lost: samples that were missing by the time of arrival.
    """

    def __init__(self, period_s: float | None = None) -> None:
        self._told = period_s
        self.lost = 0
        self._origin_s: float | None = None  # host time of the first sample of all
        self.reattach()

    def reattach(self) -> None:
        """The line was opened anew: time goes on, the loop begins again."""
        self.period_s = self._told
        self._waiting: list[SampleBlock] = []
        self._anchor: tuple[float, int] | None = None  # time and number of the last dated sample

    def date(self, block: SampleBlock) -> SampleBlock | None:
        """The block, and those that waited, with their times, s from the first sample on; None: still waiting."""
        if self.period_s is None:
            self._waiting.append(block)
            if not self._measure():
                return None
            waiting, self._waiting = self._waiting, []
            return concatenate([self._dated(b) for b in waiting])
        return self._dated(block)

    def _measure(self) -> bool:
        """The period from what waits: the slope of arrival over number of each read's last sample; False: not yet."""
        waiting = self._waiting
        full = sum(map(len, waiting)) > _MOST_WAITING
        span_s = waiting[-1].host_time_s - waiting[0].host_time_s
        if not full and (span_s < MEASURE_S or len(waiting) < MEASURE_READS):
            return False
        number = np.array([b.sequence[-1] for b in waiting], np.float64)
        arrival = np.array([b.host_time_s for b in waiting])
        number -= number.mean()
        size = float(number @ number)
        slope = float(number @ (arrival - arrival.mean())) / size if size else 0.0
        if not slope > 0.0:  # all in one instant: it had waited in a buffer
            self._waiting = waiting[-1:]
            return False
        self.period_s = slope
        return True

    def _dated(self, block: SampleBlock) -> SampleBlock:
        period_s, n = self.period_s, len(block)
        assert period_s is not None
        number, quality = block.sequence + self.lost, block.quality
        if self._origin_s is None:
            self._origin_s = block.host_time_s - (n - 1) * period_s
        arrival_s = block.host_time_s - self._origin_s
        if self._anchor is None:
            self._anchor = (arrival_s - n * period_s, int(number[0]) - 1)
        anchor_s, anchor = self._anchor
        late_s = arrival_s - (anchor_s + (int(number[-1]) - anchor) * period_s)
        if late_s > max(GAP_S, GAP_PERIODS * period_s):
            missing = round(late_s / period_s)
            self.lost += missing
            number, quality, late_s = number + missing, quality.copy(), late_s - missing * period_s
            quality[0] |= np.uint8(Quality.GAP_BEFORE)
        gain = min(1.0, n / SMOOTHING)
        shift_s = max(gain * late_s, -0.5 * n * period_s)  # time never stands still
        even = anchor_s + (number - anchor) * period_s
        time_s = even + shift_s * np.arange(1, n + 1) / n
        self._anchor = float(time_s[-1]), int(number[-1])
        if self._told is None:
            self.period_s = max(0.5 * period_s, period_s + 0.25 * gain * shift_s / n)
        return replace(block, time_s=time_s, sequence=number, quality=quality)
