"""When a limit is reached: futures drawn from what the series leaves open, the wandering of the rate included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from servo_daemon.samples import F64
from servo_daemon.trend.evidence import Fit
from servo_daemon.trend.records import HORIZON_Y
from servo_daemon.trend.shapes import BETWEEN, Columns, Priors, knots, path

#: Futures drawn: an end of the 80 % interval is then within 2 % of probability (binomial, 1 standard deviation 1.3 %).
_DRAWS: Final = 600
#: Times looked at, from two days to the horizon, each 6 % later than the one before.
_AHEAD_Y: Final = np.concatenate([[0.0], np.geomspace(0.005, HORIZON_Y, 150)])
#: The rate is that over the next days, years.
_SOON_Y: Final = 0.02


@dataclass(frozen=True, slots=True)
class Futures:
    """Drawn futures; the value relative to the reference, its season and temperature effect taken out.

    Attributes:
        now: shape (m,). `rate_1_y`: its change in a year at the present rate, shape (m,).
        paths: shape (m, k), at `ahead_y`, shape (k,).
    """

    now: F64
    rate_1_y: F64
    paths: F64
    ahead_y: F64

    def years_until(self, limit: float, *, is_upper: bool) -> F64:
        """Of each future, until it first reaches the limit; inf: not within the horizon. Shape (m,)."""
        excess = (self.paths - limit) * (1.0 if is_upper else -1.0)
        beyond = excess >= 0.0
        at = np.argmax(beyond, axis=1)
        rows = np.arange(len(at))
        before = np.maximum(at - 1, 0)
        low, high = excess[rows, before], excess[rows, at]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(at > 0, -low / (high - low), 0.0)
        years = self.ahead_y[before] + share * (self.ahead_y[at] - self.ahead_y[before])
        return np.where(beyond.any(axis=1), np.where(at > 0, years, 0.0), np.inf)


def futures(fits: Sequence[Fit], weights: F64, columns: Columns, priors: Priors, now_y: float) -> Futures:
    """Futures of fits in proportion to their weights; the same every time.

    Args:
        now_y: since the trend began, years.
    """
    rng = np.random.default_rng(0)
    counts = rng.multinomial(_DRAWS, weights / weights.sum())
    parts = [_drawn(f, int(m), columns, priors, now_y, rng) for f, m in zip(fits, counts, strict=True) if m]
    now, rate, paths = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Futures(now, rate, paths, _AHEAD_Y)


def _drawn(
    fit: Fit, draws: int, columns: Columns, priors: Priors, now_y: float, rng: np.random.Generator
) -> tuple[F64, F64, F64]:
    size = len(fit.mean)
    count = fit.freedom + size
    variance = fit.variance * count / rng.chisquare(fit.freedom, draws)
    spread = solve_triangular(fit.factor, rng.normal(size=(size, draws)), lower=True, trans="T", check_finite=False)
    beta = fit.mean[:, None] + spread * np.sqrt(variance)
    level = beta[0] + beta[size - len(fit.steps) :].sum(axis=0)
    trend = beta[len(columns.common) : size - len(fit.steps)]
    paths = level[:, None] + np.zeros(len(_AHEAD_Y))
    rate = np.zeros(draws)
    if fit.shape.kind not in ("none", "stepwise"):
        between: F64 = np.zeros((draws, 1))
        if fit.shape.rate_1_y > 0:
            safe = np.where(trend[0] == 0.0, np.inf, trend[0])
            between, trend = np.clip(trend[1] / safe, -BETWEEN, BETWEEN)[:, None], np.delete(trend, 1, axis=0)
        curve = path(fit.shape, now_y + _AHEAD_Y, now_y, between)
        soon = path(fit.shape, np.array([now_y + _SOON_Y]), now_y, between) - curve[..., :1]
        paths, rate = paths + trend[0][:, None] * curve, trend[0] * soon[..., 0] / _SOON_Y
        trend = trend[1:]
    walk = np.concatenate([np.zeros((draws, 1)), _walk(np.diff(_AHEAD_Y), draws, rng)], axis=1)
    if fit.shape.bending:
        paths = paths + trend.T @ np.maximum(now_y + _AHEAD_Y - knots(now_y)[:, None], 0.0)
        bends = np.cumsum(walk[:, :-1] * np.diff(_AHEAD_Y), axis=1)
        paths[:, 1:] += fit.shape.bending * priors.rate_1_y * bends
        rate = rate + trend.sum(axis=0)
    if fit.shape.wandering:
        paths = paths + trend.sum(axis=0)[:, None] + fit.shape.wandering * priors.margin * walk
    now = paths[:, 0].copy()
    more, step_rate = _steps_to_come(fit, now_y, draws, rng)
    return now, rate + step_rate, paths + more


def _walk(gaps_y: F64, draws: int, rng: np.random.Generator) -> F64:
    """A random walk of 1 in a year, at the ends of the gaps; shape (draws, k - 1)."""
    return np.cumsum(rng.normal(size=(draws, len(gaps_y))) * np.sqrt(gaps_y), axis=1)


#: So many steps of one direction are a habit, fewer are single events.
FEWEST_STEPS: Final = 3


def has_habit(fit: Fit) -> bool:
    """Whether more steps are to come: there have been enough, all of one direction."""
    sizes = [size for _, size in fit.events]
    return len(sizes) >= FEWEST_STEPS and abs(np.sign(sizes).sum()) == len(sizes)


def _steps_to_come(fit: Fit, now_y: float, draws: int, rng: np.random.Generator) -> tuple[F64, F64]:
    """Steps as often and as large as those so far: a Poisson process of exponential sizes, both known as well as so
    many of them tell. Shapes (draws, k) or (1, 1), and (draws,)."""
    if not has_habit(fit):
        return np.zeros((1, 1)), np.zeros(draws)
    n, total = len(fit.events), sum(size for _, size in fit.events)
    often_1_y = rng.gamma(n, 1.0 / now_y, draws)
    mean = total / rng.gamma(n, 1.0, draws)
    gaps = np.diff(_AHEAD_Y, prepend=0.0)
    counts = rng.poisson(often_1_y[:, None] * gaps)
    heights = rng.standard_gamma(np.maximum(counts, 1e-9)) * (counts > 0) * mean[:, None]
    return np.cumsum(heights, axis=1), often_1_y * mean
