"""Weights for samples that lie: a spike of a converter, a glitch of a decoder.

Only isolated ones lose weight. What a model gets wrong lasts: residuals that stay large over many samples are what the
fit is for, and down-weighting them would hide the very effect that is missing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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
        differences = [_from_neighbours(r[:, k]) for r in residuals]
        scale = 1.4826 * float(np.median(np.abs(np.concatenate(differences))))
        # Neighbours that differ by nothing (a standing encoder): no scale by which anything could stand out.
        rms = float(np.sqrt(np.mean(np.concatenate(differences) ** 2)))
        left = float(np.sqrt(np.mean(np.concatenate([r[:, k] for r in residuals]) ** 2)))
        scale = max(scale, 0.1 * rms, _OF_RESIDUAL * left)
        if scale == 0.0:
            continue
        for weight, d in zip(out, differences, strict=True):
            suspect = np.abs(d) > GATE * scale
            if suspect.any():
                isolated = suspect & ~_long_runs(suspect)
                weight[isolated, k] = (GATE * scale / np.abs(d[isolated])) ** 2
    return out


def _from_neighbours(r: F64) -> F64:
    """Each residual minus the median of those around it, shape (n,)."""
    reach = LONGEST_GLITCH + 1
    if len(r) < 2 * reach + 1:
        return r - np.median(r)
    padded = np.concatenate([np.full(reach, r[0]), r, np.full(reach, r[-1])])
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    return np.asarray(r - np.median(around, axis=1))


def _long_runs(mask: np.ndarray) -> np.ndarray:
    """Where the mask holds for more than `LONGEST_GLITCH` samples in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    out = np.zeros_like(mask)
    for begin, end in edges.reshape(-1, 2):
        if end - begin > LONGEST_GLITCH:
            out[begin:end] = True
    return out
