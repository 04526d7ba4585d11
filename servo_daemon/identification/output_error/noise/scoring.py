"""Fisher scoring of −2 log p = Σ log s + Σ ε², from innovations and their variances alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.numerics import score_and_information
from servo_daemon.samples import F64

#: Promise of −2 log p below which it is over; most steps.
_ENOUGH, _ROUNDS = 1e-2, 30
_RIDGE, _MOST_DAMPING = 1e-9, 1e6

#: ε and log s of all samples, shape (N,) each, as a function of the coordinates.
Innovations = Callable[[F64], tuple[F64, F64]]


@dataclass(frozen=True, slots=True)
class Found:
    """Where it ended.

    Attributes:
        at: all coordinates.
        value: −2 log p.
        hessian: expected, of −2 log p, by the coordinates that were free; as it was before the last step.
        converged: no step promises anything any more.
    """

    at: F64
    value: float
    hessian: F64
    converged: bool


def deviance(innovations: tuple[F64, F64]) -> float:
    """−2 log p of ε and log s."""
    e, logs = innovations
    return float(np.sum(logs + e * e))


@dataclass(frozen=True, slots=True)
class Axes:
    """The coordinates, k of them; all shapes (k,).

    Attributes:
        low, high: bounds.
        difference: by which each is moved for a derivative.
        longest: step.
    """

    low: F64
    high: F64
    difference: F64
    longest: F64


def fisher_scoring(innovations: Innovations, start: F64, free: Sequence[int], axes: Axes) -> Found:
    """The most likely coordinates near a start.

    Args:
        start: shape (k,).
        free: which of them may move.
    """
    free, at, damping, converged = list(free), start.copy(), 0.0, False
    low, high, longest = axes.low[free], axes.high[free], axes.longest[free]
    here, H = innovations(at), np.zeros((len(free), len(free)))
    for _ in range(_ROUNDS):
        g, H = _derivatives(innovations, at, here, free, axes.difference)
        held = (at[free] <= low) & (g > 0) | (at[free] >= high) & (g < 0)
        open_ = np.flatnonzero(~held)
        if not len(open_):
            break
        A = H[np.ix_(open_, open_)]
        step = np.zeros(len(free))
        step[open_] = -np.linalg.solve(A + np.diag((damping + _RIDGE) * np.maximum(np.diag(A), _RIDGE)), g[open_])
        step *= min(1.0, 1.0 / max(float(np.max(np.abs(step) / longest)), 1e-300))
        if -float(g @ step) < _ENOUGH:
            converged = True
            break
        trial = at.copy()
        trial[free] = np.clip(at[free] + step, low, high)
        there = innovations(trial)
        if deviance(there) < deviance(here):
            at, here, damping = trial, there, damping / 10
        else:
            damping = max(10 * damping, 1e-2)
            if damping > _MOST_DAMPING:
                break
    return Found(at, deviance(here), H, converged)


def _derivatives(
    innovations: Innovations, at: F64, here: tuple[F64, F64], free: Sequence[int], difference: F64
) -> tuple[F64, F64]:
    """Gradient and expected Hessian of −2 log p."""
    e, logs = here
    d_e, d_logs = np.empty((len(free), len(e))), np.empty((len(free), len(e)))
    for row, k in enumerate(free):
        moved = at.copy()
        moved[k] += difference[k]
        e1, logs1 = innovations(moved)
        d_e[row], d_logs[row] = (e1 - e) / difference[k], (logs1 - logs) / difference[k]
    return score_and_information(e, d_e, d_logs)
