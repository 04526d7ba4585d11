"""Recursive least squares that says how old it is: y = Φ θ + e over several sliding windows side by side.

Blocks of rows enter in information form, and leave again when they are as old as the window is long:

    A = Σ ΦᵀΦ,  b = Σ Φᵀy,  c = Σ y²:    θ = A⁻¹ b,   residual = c − bᵀ θ

So nothing that is known of any direction is older than the longest window. (Exponential forgetting keeps what is not
excited any more for as many memories as it was excited better than now; directional forgetting for ever.)

A long window averages noise, a short one follows a motor that changes. Which of them to believe the rows decide: a
window across which the motor has changed closes its balance worse than a shorter one. What it leaves beyond the noise
may lie along any parameter's term (Cauchy–Schwarz: the bias is at most √((A⁻¹)ₖₖ Σ e²)), and stands in its covariance;
the window with the smallest standard deviations is the estimate, unless the shortest one excludes it (bias against
variance by the data themselves: Lepski, *Theory Probab. Appl.* 35, 1991; Goldenshluger & Nemirovski, *Math. Methods
Statist.* 6, 1997). The newest rows by themselves are held against it as well, so that a step is doubted at once.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.regression.rls_fit import SYSTEMATIC, Block, Fit, excludes, fitted, structure, unexplained
from servo_daemon.samples import F64

#: Lengths of the windows, s. The longest averages what noise there is and spans a slow motion's period; the shortest
#: still holds enough rows of the shaft (50) to tell five coefficients. `benchmarks.tracking witness`: with five
#: windows, or others by a factor of 1.5, the errors under ageing are the same within a tenth.
SPANS_S = (2.5, 10.0, 40.0)
#: No variance is smaller.
_TINY = 1e-300


@dataclass(frozen=True, slots=True)
class LinearEstimate:
    """θ of y = Φ θ: value shape (n,), covariance shape (n, n), and the variance of one row's error.

    The covariance holds the noise, which averages out, and what does not: an error of the model of the share
    `SYSTEMATIC` of y, as if it stood in every row in the worst way, and what the rows leave beyond their noise. Where a
    regressor is nothing but noise (its coefficient is then drawn towards zero, as always with errors in variables), it
    is this that says so.

    Attributes:
        span_s: how far back the estimate looks.
        closes: the rows leave nothing beyond their noise.
    """

    value: F64
    covariance: F64
    residual_var: float
    span_s: float
    closes: bool


class SlidingRls:
    """Recursive least squares over sliding windows, fed blocks of rows.

    Args:
        n: number of coefficients.
        spans_s: lengths of the windows, increasing.
    """

    def __init__(self, n: int, spans_s: Sequence[float] = SPANS_S) -> None:
        self._n, self._spans_s = n, tuple(spans_s)
        self._blocks: deque[tuple[float, F64]] = deque()  # time and `packed`
        self._newest: Block | None = None
        self._estimate: LinearEstimate | None = None
        self._is_fresh = True

    def update(
        self, time_s: float, gram: F64, rows: int, noise: F64 | None = None, expected: float | None = None
    ) -> None:
        """Take a block of rows. Such as are not finite must not be among them.

        Args:
            time_s: when they end; increasing.
            gram: of [Φ | y], shape (n + 1, n + 1).
            noise: what of the diagonal of ΦᵀΦ is noise of the regressors, shape (n,): compensated in the estimate
                (bias-compensated least squares; Stoica & Söderström, *Automatica* 18, 1982), as far as it is the
                smaller part.
            expected: Σ of squares that the sensors' noise leaves of these rows at the most; None: not known.
        """
        if rows == 0:
            return
        told = 0.0 if expected is None else rows
        self._newest = Block(time_s, gram, np.zeros(self._n) if noise is None else noise, rows, told, expected or 0.0)
        self._blocks.append((time_s, self._newest.packed))
        self._is_fresh = False
        self.advance(time_s)

    def advance(self, time_s: float) -> None:
        """The present: rows older than the longest window drop out, also where no new ones come."""
        while self._blocks and time_s - self._blocks[0][0] >= self._spans_s[-1]:
            self._blocks.popleft()
            self._is_fresh = False

    @property
    def value(self) -> F64 | None:
        """The coefficients as they were last asked for, shape (n,); None as for `estimate`."""
        return None if self._estimate is None else self._estimate.value

    def estimate(self) -> LinearEstimate | None:
        """None until there are more rows than coefficients, and where some direction is not seen."""
        if not self._is_fresh:
            self._estimate, self._is_fresh = self._best(), True
        return self._estimate

    def _best(self) -> LinearEstimate | None:
        """Over the window that is known best, with what it leaves unexplained."""
        fits = self._fits()
        newest = self._newest
        if not fits or newest is None:
            return None
        alone = fitted(0.0, newest)
        quiet = min(fits if alone is None else (*fits, alone), key=lambda fit: fit.residual_var)
        best: LinearEstimate | None = None
        least = math.inf
        for fit in fits:
            if excludes(fits[0], fit.value):
                continue
            left, changed = structure(fit, quiet), unexplained(newest, fit.value, fits[0], quiet)
            own = fit.residual_var + SYSTEMATIC**2 * fit.energy + left
            covariance = fit.inverse * own + fits[0].inverse * changed
            spread = float(np.log(np.maximum(covariance.diagonal(), _TINY)).sum())
            if spread < least:
                closes = left + changed == 0.0
                least, best = spread, LinearEstimate(fit.value, covariance, fit.residual_var, fit.span_s, closes)
        return best

    def _fits(self) -> list[Fit]:
        """Of each window that determines the coefficients, the shortest first."""
        if not self._blocks:
            return []
        # Backwards from the newest: sums over each window stand at its oldest block.
        times_s, packed = zip(*reversed(self._blocks), strict=True)
        sums, ages_s = np.cumsum(packed, axis=0), times_s[0] - np.array(times_s)
        last = (np.searchsorted(ages_s, self._spans_s) - 1).tolist()
        fits = [
            fitted(span_s, Block.unpacked(times_s[k], sums[k], self._n))
            for span_s, k in zip(self._spans_s, last, strict=True)
        ]
        return [fit for fit in fits if fit is not None]
