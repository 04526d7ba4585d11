"""Whether a channel shows noise and nothing else: white, and nothing in it follows what could have moved it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servo_daemon.samples import F64

#: A correlation, in units of 1/√n, and a mean, in its standard deviations, that chance makes once in 16,000 times; and
#: fewest samples that it is asked of.
_BY_CHANCE, _FEWEST = 4.0, 100


class NoiseAlone:
    """Sums over a channel's samples and those of its possible causes, as many at a time as there are."""

    def __init__(self) -> None:
        self._gram: F64 | None = None
        self._before: F64 | None = None

    def take(self, values: F64, causes: Sequence[F64]) -> None:
        """The next samples of the channel and of each cause, shapes (n,); values near zero (of an angle those from its
        first place)."""
        now = np.column_stack([values, *causes])
        rows = now if self._before is None else np.vstack([self._before, now])
        self._before = rows[-1:]
        lagged = np.column_stack([np.ones(len(rows) - 1), rows[1:], rows[:-1]])
        gram = lagged.T @ lagged
        self._gram = gram if self._gram is None else self._gram + gram

    @property
    def samples(self) -> int:
        return 0 if self._gram is None else round(float(self._gram[0, 0]))

    @property
    def asked(self) -> bool:
        """Whether there are enough samples to say."""
        return self.samples >= _FEWEST

    def holds(self, *, about_zero: bool) -> bool:
        """Whether the channel is white and follows no cause at the same sample or the one before.

        Args:
            about_zero: its mean is zero, too.
        """
        if self._gram is None or not self.asked:
            return False
        n = self._gram[0, 0]
        mean = self._gram[0, 1:] / n
        C = self._gram[1:, 1:] / n - np.outer(mean, mean)
        then = len(C) // 2
        square = float(C[0, 0])
        if about_zero and abs(mean[0]) > _BY_CHANCE * math.sqrt(max(square, 0.0) / n):
            return False
        if C[0, 0] + C[then, then] - 2.0 * C[0, then] < square:  # of white noise it is twice as much
            return False
        causes = [k for k in range(1, len(C)) if k != then]
        return all(abs(C[0, k]) <= _BY_CHANCE * math.sqrt(max(square * C[k, k], 0.0) / n) for k in causes)
