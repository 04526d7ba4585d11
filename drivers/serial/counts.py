"""A position counter that wraps, made continuous."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from servo_daemon.samples import I64


class CountUnwrapper:
    """Adds up the steps of a counter, each taken as the nearer of its two meanings.

    Args:
        modulus: the counter wraps from this to 0, counts; between two samples it moves by less than half of it.
    """

    def __init__(self, modulus: int) -> None:
        self.modulus = modulus
        self._raw: int | None = None
        self._total = 0

    def unwrap(self, raw: I64, restarts: I64 | None = None) -> I64:
        """Continuous counts, shape (n,), from what the device showed, shape (n,), n >= 1.

        Args:
            restarts: indices of samples at which the device counts anew: the result is what it shows there.
        """
        if restarts is None or restarts.size == 0:
            return self._unwrap_run(raw)
        pieces = []
        cuts = [0, *restarts.tolist(), raw.shape[0]]
        for start, stop in pairwise(cuts):
            if start < stop:
                pieces.append(self._unwrap_run(raw[start:stop]))
            self._raw = None
        return np.concatenate(pieces)

    def _unwrap_run(self, raw: I64) -> I64:
        if self._raw is None:
            self._raw = self._total = int(raw[0])
        steps = np.empty_like(raw)
        steps[0] = int(raw[0]) - self._raw
        np.subtract(raw[1:], raw[:-1], out=steps[1:])
        half = self.modulus // 2
        if int(steps.max()) < half and int(steps.min()) >= -half:
            total = raw + (self._total - self._raw)
        else:
            total = self._total + np.cumsum((steps + half) % self.modulus - half)
        self._raw, self._total = int(raw[-1]), int(total[-1])
        return total
