"""Frames that wait until it is known what they mean, or when they were sent."""

from __future__ import annotations

from collections import deque

from drivers.can.decode import FrameBatch

#: Listened to so long before the first look, and between two looks, s: three times the slowest rate of interest, 2 Hz.
LEARN_S = 1.5
#: No more than the last so many batches are kept.
_MOST_BATCHES = 2_000


class Waiting:
    """Batches of one drive, the last of them, and when they are to be looked at.

    Attributes:
        batches: the oldest first.
    """

    def __init__(self) -> None:
        self.batches: deque[FrameBatch] = deque(maxlen=_MOST_BATCHES)
        self._looked_s: float | None = None

    def take(self, batch: FrameBatch) -> bool:
        """Keep another batch; whether it is time to look at all of them."""
        self.batches.append(batch)
        if self._looked_s is None:
            self._looked_s = batch.host_s
        elif batch.host_s - self._looked_s >= LEARN_S:
            self._looked_s = batch.host_s
            return True
        return False
