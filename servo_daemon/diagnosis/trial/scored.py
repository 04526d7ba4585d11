"""Errors of free runs, each from the initial state that suits it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.identification.output_error.diverged_segments import diverged, error_of, grown, settled
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.rollout import TIME
from servo_daemon.identification.output_error.problem.score import slope
from servo_daemon.samples import F64

#: Keeps the logarithm of an error of nothing finite.
_TINY = 1e-24


@dataclass(frozen=True, slots=True)
class Scored:
    """Errors of the free runs of one part, h of them, c channels.

    Attributes:
        squares: shape (h, c), sums of squares.
        counts: shape (h, c), samples.
        spread: shape (c,), RMS of the measured channels about their means.
        speed_rmse: of the speed, rad/s, where the angle is measured; else None.
    """

    squares: F64
    counts: F64
    spread: F64
    speed_rmse: float | None = None

    @property
    def nrmse(self) -> float:
        """RMS error over the signal's RMS, the geometric mean over channels: what falls with the likelihood, however
        noisy one of the channels is."""
        return float(np.sqrt(self.mean_square(np.ones(len(self.squares)))))

    def mean_square(self, weights: F64) -> F64:
        """Its square, each free run counted so many times; weights: shape (…, h), result: shape (…,)."""
        mse = (weights @ self.squares) / np.maximum(weights @ self.counts, 1.0)
        return np.asarray(np.exp(np.mean(np.log(mse / self.spread**2 + _TINY), axis=-1)))

    @property
    def mse(self) -> F64:
        """Mean square error of each channel, shape (c,)."""
        return np.asarray(self.squares.sum(axis=0) / np.maximum(self.counts.sum(axis=0), 1.0))


def scored_states(problem: Problem) -> Scored:
    """Errors of free runs whose initial states are fitted and nothing else."""
    spread, c = problem.spread, len(problem.channels)
    counts = np.array([s.valid.sum(axis=0).astype(float) for s in problem.segments]).reshape(-1, c)
    found = settled(problem)
    if found is None:
        return Scored(np.full_like(counts, np.inf), counts, spread)
    residuals = list(found.point.linearisation.residuals)
    squares = np.array([(r * r).sum(axis=0) for r in residuals]).reshape(-1, c)
    for k in diverged(squares, spread):
        again = grown(problem, k)
        if again is not None and error_of(again[1], spread) < error_of(residuals[k], spread):
            residuals[k] = again[1]
            squares[k] = (again[1] * again[1]).sum(axis=0)
    return Scored(squares, counts, spread, _speed_rmse(problem, residuals))


def _speed_rmse(problem: Problem, residuals: Sequence[F64]) -> float | None:
    """Measured and simulated speed are slopes of angles: their difference is the slope of the angle's residual."""
    if "position_rad" not in problem.channels:
        return None
    k = problem.channels.index("position_rad")
    slopes = [slope(r[:, k], s.rows[:, TIME]) for r, s in zip(residuals, problem.segments, strict=True)]
    return float(np.sqrt(np.mean(np.square(np.concatenate(slopes)))))
