"""Weights for samples that lie: a spike of a converter, a glitch of a decoder.

Only isolated ones lose weight. What a model gets wrong lasts: residuals that stay large over many samples are what the
fit is for, and down-weighting them would hide the very effect that is missing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servo_daemon.numerics import STD_OF_MEDIAN
from servo_daemon.samples import F64

#: A residual that stands out from its neighbours by more standard deviations is suspect (Gaussian: 1 in 1.7 million).
GATE = 5.0
#: … and so is only one that stands out from what the model leaves anyway.
_OF_RESIDUAL = 0.6
#: Longest run of suspects that still counts as isolated, samples.
LONGEST_GLITCH = 3


def sample_weights(residuals: Sequence[F64]) -> tuple[F64, ...]:
    """1; for an isolated outlier the weight at which it counts as if it stood at the gate.

    Args:
        residuals: per segment, shape (n, c).

    Returns:
        per segment, shape (n, c).
    """
    out = tuple(np.ones_like(r) for r in residuals)
    if not residuals:
        return out
    for k in range(residuals[0].shape[1]):
        r = [part[:, k] for part in residuals]
        differences = [_from_neighbours(part) for part in r]
        scale = _scale(r, differences)
        for weight, d, isolated in zip(out, differences, _isolated(differences, scale), strict=True):
            weight[isolated, k] = (GATE * scale / np.abs(d[isolated])) ** 2
    return out


def _scale(residuals: Sequence[F64], differences: Sequence[F64]) -> float:
    """By how much a sample usually stands out, and not less than a share of what the model leaves apart from glitches.

    Where most neighbours differ by nothing (a standing encoder) the 95th percentile takes the median's place.
    """
    every = np.concatenate(differences)
    middle, large = np.percentile(np.abs(every), [50.0, 95.0])
    usual = max(STD_OF_MEDIAN * float(middle), 0.51 * float(large))
    glitches = np.concatenate(_isolated(differences, usual))
    left = np.concatenate(residuals)[~glitches]
    return max(usual, _OF_RESIDUAL * float(np.sqrt(np.mean(left**2))) if left.size else 0.0)


def _isolated(differences: Sequence[F64], scale: float) -> list[NDArray[np.bool_]]:
    """Per segment, where a sample stands out by more than the gate, and few of its neighbours do."""
    if scale == 0.0:
        return [np.zeros(len(d), dtype=bool) for d in differences]
    suspects = [np.abs(d) > GATE * scale for d in differences]
    return [s & ~_long_runs(s) if s.any() else s for s in suspects]


def _from_neighbours(r: F64) -> F64:
    """Each residual minus the median of those around it, shape (n,)."""
    reach = LONGEST_GLITCH + 1
    if len(r) < 2 * reach + 1:
        return r - np.median(r)
    padded = np.concatenate([np.full(reach, r[0]), r, np.full(reach, r[-1])])
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    return np.asarray(r - np.median(around, axis=1))


def _long_runs(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where the mask holds for more than `LONGEST_GLITCH` samples in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    out = np.zeros_like(mask)
    for begin, end in edges.reshape(-1, 2):
        if end - begin > LONGEST_GLITCH:
            out[begin:end] = True
    return out
