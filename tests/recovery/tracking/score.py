"""Figures of a track against the truth, the same for every part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.tracking.follow import Z95, Flags


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Per parameter, shape (parameters,); NaN where the parameter was never counted.

    Attributes:
        rms: relative RMS error.
        inside: share of truths inside the 95 % interval.
        width: RMS of std over RMS error.
        share: share of the time in `tracking`.
    """

    rms: F64
    inside: F64
    width: F64
    share: F64


def score(value: F64, std: F64, truth: F64, tracking: Flags) -> Score:
    """Errors and intervals while tracking; all arguments of shape (m, parameters)."""
    error = np.where(tracking, value / truth - 1, np.nan)
    spread = np.where(tracking, std / np.abs(truth), np.nan)
    hits = np.where(tracking, np.abs(error) < Z95 * spread, np.nan)
    rms = root_mean_square(error)
    return Score(rms, mean(hits), root_mean_square(spread) / rms, tracking.mean(axis=0))


def mean(values: F64, axis: int = 0) -> F64:
    """Over what is not NaN; NaN where nothing is."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=axis)
    count = known.sum(axis=axis)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def root_mean_square(values: F64, axis: int = 0) -> F64:
    """Likewise."""
    return np.asarray(np.sqrt(mean(np.square(values), axis)))
