"""Where the answers of a polled drive stand in time and number."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.base import DriverCounters
from drivers.polling.poller import Answer, V
from servo_daemon.samples import F64, I64, U8, Quality


class Placing:
    """Time, number and quality of answers. Time is the host's, at which the request left; it and the numbers go on
    when the link is opened anew.

    Args:
        counters: `samples_lost` is counted up here by requests that were not answered.
    """

    def __init__(self, counters: DriverCounters) -> None:
        self._counters = counters
        self._origin_s: float | None = None
        self._offset = 0
        self._next = 0

    def reopen(self) -> None:
        """The poller counts from 0 again."""
        self._offset = self._next

    def place(self, answers: Sequence[Answer[V]]) -> tuple[F64, I64, U8]:
        """Time, s from the first answer of all, number and `Quality` of answers, n ≥ 1; all of shape (n,)."""
        sent_s = np.array([a.sent_s for a in answers])
        if self._origin_s is None:
            self._origin_s = float(sent_s[0])
        number = np.array([a.number for a in answers], np.int64) + self._offset
        if self._next == 0:  # what was asked before the first answer is no loss
            self._next = int(number[0])
        missing = np.diff(number, prepend=self._next - 1) - 1
        self._counters.samples_lost += int(missing.sum())
        self._next = int(number[-1]) + 1
        quality = np.where(missing > 0, np.uint8(Quality.GAP_BEFORE), np.uint8(0))
        return sent_s - self._origin_s, number, quality
