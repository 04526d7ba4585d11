"""Whether one model predicts the held-out parts better than another, and by how much, with an interval.

The unit of resampling is a free run: within one the errors depend on each other, between them hardly (block bootstrap,
Künsch 1989). Both models are scored on the same free runs, so what is resampled is their difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servo_daemon.diagnosis.trial import Trial
from servo_daemon.samples import F64

_RESAMPLES = 400
_SEED = 7


@dataclass(frozen=True, slots=True)
class Advantage:
    """Of the richer model over the other, on the held-out free runs.

    Attributes:
        gain: mean over channels of log(rms error of the other / rms error of the richer).
        low, high: its 98 % interval.
        delta_bic: BIC of the richer minus that of the other, on the training part: negative speaks for the richer.
    """

    gain: float
    low: float
    high: float
    delta_bic: float


def _resamples(n: int) -> F64:
    """Shape (resamples, n): how often each free run is drawn."""
    rng = np.random.default_rng(_SEED)
    return rng.multinomial(n, np.full(n, 1.0 / n), size=_RESAMPLES).astype(np.float64)


def advantage(simple: Trial, rich: Trial) -> Advantage:
    """Compare two models over the same split."""
    drawn = _resamples(len(simple.squares))

    def gains(weights: F64) -> F64:
        floor = 1e-12 * simple.test.spread**2 * simple.counts.sum(axis=0)
        a, b = weights @ simple.squares + floor, weights @ rich.squares + floor
        return np.asarray(0.5 * np.mean(np.log(a / b), axis=-1))

    spread = gains(drawn)
    low, high = np.quantile(spread, [0.01, 0.99])
    every = np.ones(len(simple.squares))
    return Advantage(float(gains(every)), float(low), float(high), _delta_bic(simple, rich))


def _delta_bic(simple: Trial, rich: Trial) -> float:
    """With the richer model's share of independent samples for both: what it leaves is nearer to noise."""
    share = rich.independent
    n = share * float(rich.train.counts.sum())
    drop = share * (simple.solution.point.value - rich.solution.point.value)
    return float((rich.free - simple.free) * np.log(max(n, 2.0)) - drop)


def error_removed(base: Trial, extended: Trial, floor_nrmse: float) -> tuple[float, tuple[float, float]]:
    """(b² − e²)/(b² − n²) and its 95 % interval, within 0 .. 1 for the figure itself.

    Args:
        floor_nrmse: n, what noise alone leaves, as `Trial.nrmse`.
    """
    drawn = _resamples(len(base.squares))
    scale = base.test.spread**2

    def mean_square(t: Trial, weights: F64) -> F64:
        return np.asarray(np.mean((weights @ t.squares) / (weights @ t.counts) / scale, axis=-1))

    def removed(weights: F64) -> F64:
        b, e = mean_square(base, weights), mean_square(extended, weights)
        room = np.maximum(b - np.minimum(floor_nrmse**2, e), 1e-300)
        return np.asarray((b - e) / room)

    low, high = np.quantile(removed(drawn), [0.025, 0.975])
    return float(removed(np.ones(len(base.squares)))), (float(low), float(min(high, 1.0)))
