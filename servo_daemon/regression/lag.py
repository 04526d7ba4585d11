"""A voltage behind a first-order lag, as a regression needs it: its mean from each sample to the next."""

from __future__ import annotations

import math

import numpy as np

from servo_daemon.samples import F64


class Lag:
    """t_lag dv/dt = v_shown − v, v_shown held between samples; goes on from block to block.

    Attributes:
        lag_s: t_lag; may change between blocks.
    """

    def __init__(self, lag_s: float) -> None:
        self.lag_s = lag_s
        self._behind: float | None = None  # v at the next sample

    def mean_of(self, time_s: F64, shown: F64) -> F64:
        """Mean of v from each sample to the next, V, shape (n,); the samples of a block are taken for evenly spaced.

        Args:
            time_s, shown: shape (n,).
        """
        from scipy.signal import lfilter

        if len(shown) == 0:
            return shown
        period_s = float(time_s[-1] - time_s[0]) / max(len(time_s) - 1, 1) or self.lag_s
        stays = math.exp(-period_s / self.lag_s)
        start = float(shown[0]) if self._behind is None else self._behind
        after, _ = lfilter([1.0 - stays], [1.0, -stays], shown, zi=[stays * start])
        before = np.concatenate([[start], after[:-1]])
        self._behind = float(after[-1])
        return np.asarray(shown + (before - shown) * (1.0 - stays) * self.lag_s / period_s)
