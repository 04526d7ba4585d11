"""Split conformal intervals (Vovk et al. 2005; Lei et al., *JASA* 113, 2018), split by motor.

On motors that took no part in fitting or choosing anything, the scores |y − ŷ|/s are collected, one window a motor (two
windows of one motor are not exchangeable with a third motor's). The ⌈(n + 1)(1 − α)⌉-th smallest is the factor q: for a
further motor from the same population ŷ ± q s holds y with a probability of at least 1 − α, whatever the learner. s is
the learner's own idea of its error there, so that intervals are wide where it knows little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64

#: A learner's own std counts from this share of its usual one: a kernel that holds one window has no spread.
_LEAST_SHARE = 0.5
_SHRUNK = 0.98
#: 95 % of fewer is more than all of them.
FEWEST_CALIBRATED = 19


@dataclass(frozen=True)
class Intervals:
    """Calibrated half widths.

    Attributes:
        factor: q for 95 %, shape (m,).
        factor_std: q for 68.3 %, shape (m,): what is published as 1 σ.
        least_std: shape (m,): floor of s.
        correlation: of the errors, shape (m, m): K, J and B go wrong together.
    """

    factor: F64
    factor_std: F64
    least_std: F64
    correlation: F64

    def half_width(self, std: F64) -> F64:
        """Of the 95 % interval; std: the learner's own, shape (n, m)."""
        return np.asarray(self.factor * np.maximum(std, self.least_std))

    def std(self, std: F64) -> F64:
        """1 σ: no less than half of what a Gaussian with this 95 % interval would have, shape (n, m)."""
        s = np.maximum(std, self.least_std)
        return np.asarray(np.maximum(self.factor_std, self.factor / 1.96) * s)


def calibrate(y: F64, predicted: F64, std: F64, groups: NDArray[np.int64]) -> Intervals:
    """Intervals from calibration motors.

    Args:
        y, predicted, std: shape (n, m).
        groups: shape (n,): the motor of each window; only the first window of each counts.

    Raises:
        ValueError: fewer motors than 95 % can be had from (19).
    """
    _, first = np.unique(groups, return_index=True)
    if len(first) < FEWEST_CALIBRATED:
        raise ValueError(f"{len(first)} motors are too few to calibrate a 95 % interval: {FEWEST_CALIBRATED} at least")
    least = np.maximum(_LEAST_SHARE * np.median(std[first], axis=0), 1e-12)
    signed = (y[first] - predicted[first]) / np.maximum(std[first], least)
    scores = np.abs(signed)
    factor = _quantile(scores, 0.95)
    # Ranks, because a few errors are large; shrunk, because with few motors a correlation can come out as 1.
    ranks = np.argsort(np.argsort(signed, axis=0), axis=0) + 1e-9 * signed
    correlation = np.atleast_2d(np.corrcoef(ranks, rowvar=False))
    correlation = _SHRUNK * np.nan_to_num(correlation) + (1.0 - _SHRUNK) * np.eye(signed.shape[1])
    np.fill_diagonal(correlation, 1.0)
    return Intervals(factor, _quantile(scores, 0.6827), least, correlation)


def _quantile(scores: F64, level: float) -> F64:
    """The ⌈(n + 1) level⌉-th smallest of each column."""
    n = len(scores)
    return np.asarray(np.sort(scores, axis=0)[min(math.ceil((n + 1) * level), n) - 1])
