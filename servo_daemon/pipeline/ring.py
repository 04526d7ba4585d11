"""The last seconds of samples, for a diagnosis: a ring of whole ticks, as the estimators saw them.

It holds one uninterrupted recording: where the motion before cannot be told (a long gap, a restart of the device, other
channels) it begins anew. Appending costs 7 µs a tick; memory is 17 bytes a sample and 8 for each channel, so a
minute of three channels is 2.5 MB at 1 kHz, and no drive's ring is larger than `MOST_SAMPLES` (25 MB).
"""

from __future__ import annotations

from collections import deque
from typing import Final

from servo_daemon.conditioning.gaps import breaks
from servo_daemon.samples import SampleBlock

#: Samples a ring holds at most, whatever its length in seconds: a minute at 10 kHz.
MOST_SAMPLES: Final = 600_000


class SampleRing:
    """Keeps the last samples of one drive. One thread appends and clears; `blocks` may be called from any.

    Args:
        seconds: of device time that are kept; 0: nothing is.
        samples: at most so many.
    """

    def __init__(self, seconds: float, samples: int = MOST_SAMPLES) -> None:
        self.seconds = seconds
        self._most = samples
        self._ticks: deque[SampleBlock] = deque()
        self._samples = 0

    def append(self, tick: SampleBlock) -> None:
        """The samples of a tick, in order; the oldest ticks go when there are more than the ring holds."""
        if self.seconds <= 0:
            return
        if self._ticks:
            last = self._ticks[-1]
            lost = breaks(tick, float(last.time_s[-1]))
            # A pipeline that was reset no longer shifts the times of a device that had restarted.
            if lost or tick.channels != last.channels or tick.time_s[0] <= last.time_s[-1]:
                self.clear()
                tick = tick.slice(lost[-1] if lost else 0, len(tick))
        self._ticks.append(tick)
        self._samples += len(tick)
        while self._samples > self._most or self.span_s > self.seconds:
            if len(self._ticks) == 1:
                break
            self._samples -= len(self._ticks.popleft())

    def clear(self) -> None:
        self._ticks.clear()
        self._samples = 0

    @property
    def samples(self) -> int:
        return self._samples

    @property
    def span_s(self) -> float:
        """From the first to the last sample, s of device time; 0 when empty."""
        ticks = self._ticks
        return float(ticks[-1].time_s[-1]) - float(ticks[0].time_s[0]) if ticks else 0.0

    def blocks(self) -> tuple[SampleBlock, ...]:
        """Its ticks, oldest first."""
        return tuple(self._ticks.copy())  # a copy is atomic; iterating while another thread appends is not
