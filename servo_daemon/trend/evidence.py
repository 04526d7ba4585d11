"""Which shape, which noise and which steps a series speaks for: Bayesian linear regression under each of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtrs

from servo_daemon.samples import F64
from servo_daemon.trend.noise import Noise, noises
from servo_daemon.trend.series import YEAR_D, Series
from servo_daemon.trend.shapes import SHAPES, Columns, Priors, Shape

#: A step nearer than so many values to an end cannot be told from an excursion.
_FROM_END: Final = 3
_MOST_STEPS: Final = 16
#: Fits less likely than the best by this factor's logarithm are left out.
_NEGLIGIBLE: Final = 8.0
#: Shapes that follow any curve: a noise less likely than the best by `_UNLIKELY` under all of these is left out.
_FLEXIBLE: Final = tuple(k for k, s in enumerate(SHAPES) if s == SHAPES[0] or s.bending or s.kind == "stepwise")
_UNLIKELY: Final = 12.0
#: Of values that are all alike: a millionth of the value, which is less than any estimate is known to.
_LEAST_VARIANCE: Final = 1e-12


@dataclass(frozen=True, slots=True)
class Fit:
    """A series under one shape and one noise, with the steps found under these.

    Attributes:
        steps: each at the first value after it.
        mean: of the columns' and then the steps' coefficients.
        factor: lower Cholesky factor of their precision, divided by the noise's variance.
        variance: of the noise; `freedom` values' worth of it are known.
        log_evidence: with the priors of shape and steps.
    """

    shape: Shape
    shape_number: int
    noise: Noise
    steps: tuple[int, ...]
    mean: F64
    factor: F64
    variance: float
    freedom: float
    log_evidence: float

    @property
    def events(self) -> tuple[tuple[int, float], ...]:
        """Steps in their order and their sizes, relative; neighbours of one direction, between which nothing can be
        told, as one."""
        sizes = self.mean[len(self.mean) - len(self.steps) :]
        out: list[tuple[int, float]] = []
        for at, size in sorted(zip(self.steps, map(float, sizes), strict=True)):
            if out and at - out[-1][0] <= _FROM_END and size * out[-1][1] > 0:
                out[-1] = (out[-1][0], out[-1][1] + size)
            else:
                out.append((at, size))
        return tuple(out)


@dataclass(frozen=True, slots=True)
class _Grams:
    """Whitened columns, then a step at every value, times themselves and the series.

    Attributes:
        products: shape (p + n, p + n). `with_value`: shape (p + n,). `value_2`: the series with itself.
        count: values, n.
    """

    products: F64
    with_value: F64
    value_2: float
    count: int


def fits(series: Series, value: F64, columns: Columns, priors: Priors) -> tuple[Fit, ...]:
    """All that are likely enough, the best first.

    Args:
        series: its times.
        value: relative to the reference, shape (n,).
    """
    n = len(value)
    steps = np.tri(n)  # column j is a step at value j
    gap_y = (series.time_d[-1] - series.time_d[0]) / YEAR_D / n
    tried: list[tuple[Noise, _Grams, list[Fit]]] = []
    for noise in noises(series.time_d, series.days):
        white = noise.whitened(np.column_stack([columns.values, steps, value]))
        products = white.T @ white
        grams = _Grams(products[:-1, :-1], products[:-1, -1], float(products[-1, -1]), n)
        tried.append((noise, grams, [_under(grams, noise, columns, priors, k, gap_y) for k in _FLEXIBLE]))
    best = max(fit.log_evidence for _, _, some in tried for fit in some)
    found: list[Fit] = []
    for noise, grams, some in tried:
        if max(fit.log_evidence for fit in some) > best - _UNLIKELY:
            others = [k for k in range(len(SHAPES)) if k not in _FLEXIBLE]
            found += [*some, *(_under(grams, noise, columns, priors, k, gap_y) for k in others)]
    found.sort(key=lambda fit: -fit.log_evidence)
    return tuple(f for f in found if f.log_evidence > found[0].log_evidence - _NEGLIGIBLE)


def _under(grams: _Grams, noise: Noise, columns: Columns, priors: Priors, number: int, gap_y: float) -> Fit:
    """Under one noise and one shape; steps are added as long as the evidence rises."""
    shape = SHAPES[number]
    chosen = [*columns.common, *columns.by_shape[number]]
    p, taken = len(columns.stds), len(chosen)
    log_step = float(np.log(min(0.5, shape.steps_1_y * gap_y)))
    stds = np.concatenate([columns.stds, np.full(grams.count, shape.step * priors.margin)])
    variance = max(grams.value_2 / grams.count, _LEAST_VARIANCE)
    for _ in range(3):
        solved = _Solved(grams, stds, chosen, variance)
        variance = solved.variance
    while len(chosen) - taken < _MOST_STEPS:
        step = solved.best_step(p, log_step)
        if step is None:
            break
        chosen.append(step)
        solved = _Solved(grams, stds, chosen, solved.variance)
    if len(chosen) > taken:  # once more with the variance of the last
        solved = _Solved(grams, stds, chosen, solved.variance)
    return Fit(
        shape,
        number,
        noise,
        tuple(j - p for j in chosen[taken:]),
        solved.mean,
        solved.factor,
        solved.variance,
        float(grams.count - len(chosen)),
        solved.log_evidence - noise.log_det + float(np.log(shape.prior)) + (len(chosen) - taken) * log_step,
    )


class _Solved:
    """The posterior with chosen columns, given the noise's variance."""

    def __init__(self, grams: _Grams, stds: F64, chosen: list[int], variance: float) -> None:
        self._grams, self._stds, self._chosen, self._given = grams, stds, chosen, variance
        precision = grams.products[np.array(chosen)[:, None], chosen]
        precision[np.diag_indices(len(chosen))] += variance / np.square(stds[chosen])
        # LAPACK itself: with matrices this small scipy's checks take longer than the work.
        self.factor: F64 = dpotrf(precision, lower=1, clean=1)[0]
        self.mean: F64 = dpotrs(self.factor, grams.with_value[chosen], lower=1)[0]
        self._misfit = grams.value_2 - float(grams.with_value[chosen] @ self.mean)

    @property
    def variance(self) -> float:
        """Of the noise, the most likely."""
        return max(self._misfit / self._grams.count, _LEAST_VARIANCE)

    @property
    def log_evidence(self) -> float:
        """But for constants, and the determinant of the noise's correlation."""
        log_det = 2.0 * float(np.log(np.diag(self.factor)).sum())
        ratio = np.log(np.square(self._stds[self._chosen]) / self._given).sum()
        n = self._grams.count
        return -0.5 * (n * float(np.log(self._given)) + log_det + float(ratio) + self._misfit / self._given)

    def best_step(self, first: int, log_prior: float) -> int | None:
        """The column of the step that raises the evidence most; None: none does."""
        g, given = self._grams, self._given
        candidates = slice(first + _FROM_END, first + g.count - _FROM_END)
        cross = g.products[self._chosen, candidates]
        half = dtrtrs(self.factor, cross, lower=1)[0]
        own = g.products.diagonal()[candidates] + given / np.square(self._stds[candidates])
        own = own - np.square(half).sum(axis=0)
        left = g.with_value[candidates] - cross.T @ self.mean
        gain = 0.5 * np.square(left) / (own * given) - 0.5 * np.log(own * np.square(self._stds[candidates]) / given)
        best = int(np.argmax(gain))
        return first + _FROM_END + best if gain[best] + log_prior > 0.0 else None
