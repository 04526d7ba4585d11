"""Weights for samples that lie: a spike of a converter, a glitch of a decoder.

Only isolated ones lose weight. What a model gets wrong lasts: residuals that stay large over many samples are what the
fit is for, and down-weighting them would hide the very effect that is missing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servo_daemon.kalman.measurement import GATE
from servo_daemon.numerics import STD_OF_MEDIAN, in_long_runs
from servo_daemon.samples import F64

#: A residual that stands out from its neighbours by more than the filter's gate is suspect, and so is only one that
#: stands out from what the model leaves anyway.
_OF_RESIDUAL = 0.6
#: Longest run of suspects that still counts as isolated, samples.
LONGEST_GLITCH = 3
#: So many neighbours on either side tell what a sample should be like.
_REACH = LONGEST_GLITCH + 1
#: The fewest exchanges that bring the median of nine to the middle (Smith, *Implementing median filters in XC4000E
#: FPGAs*, Xcell 23, 1996): whole columns at once, ten times as fast as sorting each sample's neighbours.
_EXCHANGES = (
    *((1, 2), (4, 5), (7, 8), (0, 1), (3, 4), (6, 7), (1, 2), (4, 5), (7, 8), (0, 3)),
    *((5, 8), (4, 7), (3, 6), (1, 4), (2, 5), (4, 7), (4, 2), (6, 4), (4, 2)),
)


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
        differences = _from_neighbours(r)
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
    return [s & ~in_long_runs(s, LONGEST_GLITCH + 1) if s.any() else s for s in suspects]


def _from_neighbours(residuals: Sequence[F64]) -> list[F64]:
    """Each residual minus the median of those around it, per segment, shape (n,)."""
    ends = [np.concatenate([np.full(_REACH, r[0]), r, np.full(_REACH, r[-1])]) for r in residuals]
    row = np.concatenate(ends)  # one behind the other: what reaches across an end is not looked at
    n = len(row) - 2 * _REACH
    around = _median([row[k : k + n] for k in range(2 * _REACH + 1)])
    edges = np.cumsum([0, *map(len, ends)]).tolist()
    return [
        r - (around[begin : begin + len(r)] if len(r) > 2 * _REACH else np.median(r))
        for r, begin in zip(residuals, edges, strict=False)
    ]


def _median(nine: list[F64]) -> F64:
    """Of nine columns, shape (n,)."""
    for low, high in _EXCHANGES:
        nine[low], nine[high] = np.minimum(nine[low], nine[high]), np.maximum(nine[low], nine[high])
    return nine[4]
