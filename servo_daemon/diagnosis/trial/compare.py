"""Whether one model predicts free runs that were not fitted better than another, and by how much, with an interval.

The unit of resampling is a free run: within one the errors depend on each other, between them hardly (block bootstrap,
Künsch 1989). Both models are scored on the same free runs, so what is resampled is their difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.samples import F64

#: Resamples: the 1 % quantile of a gain is the fifth of them, and known to within about half of it.
_RESAMPLES = 500
_SEED = 7


@dataclass(frozen=True, slots=True)
class Advantage:
    """Advantage of the richer model over the other, on the part that decides.

    Attributes:
        gain: mean over channels of log(rms error of the other / rms error of the richer).
        low, high: its 98 % interval.
        delta_bic: BIC of the richer minus that of the other, on the fitted part: negative speaks for the richer.
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
    return Advantage(*bootstrapped(simple.choice, rich.choice), _delta_bic(simple, rich))


def bootstrapped(a: Scored, b: Scored) -> tuple[float, float, float]:
    """Gain of b over a on the same free runs, with the ends of its 98 % interval: see `Advantage`."""

    def gains(weights: F64) -> F64:
        floor = 1e-12 * a.spread**2 * a.counts.sum(axis=0)
        return np.asarray(0.5 * np.mean(np.log((weights @ a.squares + floor) / (weights @ b.squares + floor)), axis=-1))

    low, high = np.quantile(gains(_resamples(len(a.squares))), [0.01, 0.99])
    return float(gains(np.ones(len(a.squares)))), float(low), float(high)


def surely_positive(per_run: F64) -> bool:
    """Whether a sum over free runs, shape (h,), is positive (95 %, one-sided: each run might have been drawn again)."""
    return bool(np.quantile(_resamples(len(per_run)) @ per_run, 0.05) > 0.0)


def _delta_bic(simple: Trial, rich: Trial) -> float:
    """With the richer model's share of independent samples for both: what it leaves is nearer to noise."""
    share = rich.independent
    n = share * float(rich.fitted.counts.sum())
    drop = share * (simple.solution.point.value - rich.solution.point.value)
    return float((rich.free - simple.free) * np.log(max(n, 2.0)) - drop)


#: A share of the removable error, and the ends of its 95 % interval, where there are.
Share = tuple[float | None, tuple[float, float] | None]


def error_removed(base: Scored, extended: Scored, floor: Scored) -> Share:
    """(b² − e²)/(b² − n²) and its 95 % interval; None where noise leaves as much as the baseline does, so that nothing
    could be removed. An end is infinite where that may be so by chance.

    Args:
        floor: n, what noise alone leaves of the same free runs.
    """
    return share_of_removable(base, base, extended, floor)


def share_of_removable(base: Scored, worse: Scored, better: Scored, floor: Scored) -> Share:
    """(w² − g²)/(b² − n²), as `error_removed` has it: what one model of several is better by than another."""

    def removed(weights: F64) -> tuple[F64, F64]:
        b, w, g, n = (x.mean_square(weights) for x in (base, worse, better, floor))
        return w - g, b - n

    taken, room = removed(np.ones(len(base.squares)))
    if not room > 0.0:
        return None, None
    difference, left = removed(_resamples(len(base.squares)))
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(left > 0.0, difference / left, np.copysign(np.inf, difference))
    # No value between two of the resamples': one of them may be infinite.
    low = np.quantile(shares, 0.025, method="lower")
    high = np.quantile(shares, 0.975, method="higher")
    return float(taken / room), (float(low), float(high))
