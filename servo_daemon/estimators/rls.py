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

from servo_daemon.estimators.small_matrices import eigen, eigenvalues
from servo_daemon.samples import F64

#: Lengths of the windows, s. The longest averages what noise there is and spans a slow motion's period; the shortest
#: still holds enough rows of the shaft (50) to tell five coefficients. `benchmarks.tracking witness`: with five
#: windows, or others by a factor of 1.5, the errors under ageing are the same within a tenth.
SPANS_S = (2.5, 10.0, 40.0)
#: By how much the model of a row may be off, as a share of y: dead time, ripple, friction that is not quite viscous.
SYSTEMATIC = 1e-3
#: A balance that closes to this share (rms) closes: its parameters change while it is summed up, and integrals over
#: samples are no more exact.
CLOSES = 0.01
#: Windows of the modulating functions overlap by half, so neighbouring rows share half their noise: covariances are
#: that much too small.
OVERLAP = 2.0
#: Noise is compensated only while it is a smaller part of every regressor than the second, and a larger part of one
#: than the first: what is less moves nothing.
_LEAST_NOISE, _MOST_NOISE = 1e-12, 0.3
#: A column this much smaller than the largest is zero: no units of motors differ by as much.
_INVISIBLE = 1e-12
#: Least information of a direction, each column over its own size: rounding is smaller, and two columns that are the
#: same (friction and load of a motor that turns one way) leave only their own coefficients unknown.
_LEAST_SHARE = 1e-9
#: Fewest rows for each coefficient.
_ROWS_PER_COEFFICIENT = 2.0
#: A sum of squares is larger than expected, and a window excluded, beyond so many standard deviations of what chance
#: makes of it.
_CHANCE_STDS = 4.0
#: What the rows leave goes up and down with the motion by this factor (in squares; jitter, what the current does
#: between samples): with 1 a steady motor's standard deviations were up to five times as large for no error.
_LEVEL_VARIES = 2.0
#: A sum of squares is no smaller than this share of y's: rounding. No variance is smaller than the second.
_EXACT, _TINY = 1e-15, 1e-300


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


@dataclass(frozen=True, slots=True)
class _Block:
    """Rows that end at about `time_s`, or sums over several blocks.

    Attributes:
        gram: of [Φ | y], shape (n + 1, n + 1).
        noise: what of the diagonal of ΦᵀΦ is noise of the regressors, shape (n,).
        rows, told: how many, and of how many the expected residual is known.
        expected: that residual's Σ of squares.
    """

    time_s: float
    gram: F64
    noise: F64
    rows: float
    told: float
    expected: float

    @property
    def packed(self) -> F64:
        """All but the time in one array, so that blocks are summed in one go."""
        return np.concatenate([self.gram.ravel(), self.noise, (self.rows, self.told, self.expected)])

    @classmethod
    def unpacked(cls, time_s: float, sums: F64, n: int) -> _Block:
        """Of n coefficients."""
        end = (n + 1) ** 2
        return cls(time_s, sums[:end].reshape(n + 1, n + 1), sums[end : end + n], *sums[end + n :].tolist())


@dataclass(frozen=True, slots=True)
class _Fit:
    """Over one window: value shape (n,), inverse and information shape (n, n).

    Attributes:
        left, energy: Σ of squares that the fit leaves of y, and of y.
        rows: how many.
        expected: of what is left, what the sensors' noise explains; infinite where it is not known.
    """

    span_s: float
    value: F64
    inverse: F64
    information: F64
    left: float
    energy: float
    rows: float
    expected: float

    @property
    def residual_var(self) -> float:
        """Of one row."""
        return self.left / (self.rows - len(self.value))

    @property
    def chance(self) -> float:
        """By how much larger than expected, as a share, a sum of squares is by chance."""
        return _CHANCE_STDS * math.sqrt(2.0 * OVERLAP / (self.rows - len(self.value)))


class SlidingRls:
    """Fed blocks of rows.

    Args:
        n: number of coefficients.
        spans_s: lengths of the windows, increasing.
    """

    def __init__(self, n: int, spans_s: Sequence[float] = SPANS_S) -> None:
        self._n, self._spans_s = n, tuple(spans_s)
        self._blocks: deque[tuple[float, F64]] = deque()  # time and `packed`
        self._newest: _Block | None = None
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
        self._newest = _Block(time_s, gram, np.zeros(self._n) if noise is None else noise, rows, told, expected or 0.0)
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
        alone = self._fit(0.0, newest)
        quiet = min(fits if alone is None else (*fits, alone), key=lambda fit: fit.residual_var)
        best: LinearEstimate | None = None
        least = math.inf
        for fit in fits:
            if _excludes(fits[0], fit.value):
                continue
            structure, changed = _structure(fit, quiet), _unexplained(newest, fit.value, fits[0], quiet)
            own = fit.residual_var + SYSTEMATIC**2 * fit.energy + structure
            covariance = fit.inverse * own + fits[0].inverse * changed
            spread = float(np.log(np.maximum(covariance.diagonal(), _TINY)).sum())
            if spread < least:
                closes = structure + changed == 0.0
                least, best = spread, LinearEstimate(fit.value, covariance, fit.residual_var, fit.span_s, closes)
        return best

    def _fits(self) -> list[_Fit]:
        """Of each window that determines the coefficients, the shortest first."""
        if not self._blocks:
            return []
        # Backwards from the newest: sums over each window stand at its oldest block.
        times_s, packed = zip(*reversed(self._blocks), strict=True)
        sums, ages_s = np.cumsum(packed, axis=0), times_s[0] - np.array(times_s)
        last = (np.searchsorted(ages_s, self._spans_s) - 1).tolist()
        fits = [
            self._fit(span_s, _Block.unpacked(times_s[k], sums[k], self._n))
            for span_s, k in zip(self._spans_s, last, strict=True)
        ]
        return [fit for fit in fits if fit is not None]

    def _fit(self, span_s: float, sums: _Block) -> _Fit | None:
        A, b, energy, rows = sums.gram[:-1, :-1], sums.gram[:-1, -1], float(sums.gram[-1, -1]), sums.rows
        scale = np.sqrt(A.diagonal())
        # A regressor that is (all but) zero: also one that was in the beginning and is dying away.
        if rows <= _ROWS_PER_COEFFICIENT * self._n or scale.min() < _INVISIBLE * max(float(scale.max()), 1e-7):
            return None
        square = scale[:, None] * scale
        values, vectors = eigen(A / square)
        inverse = (vectors / np.maximum(values, _LEAST_SHARE)) @ vectors.T / square
        biased = inverse @ b
        left = max(energy - float(b @ biased), _EXACT * energy)
        expected = sums.expected * rows / sums.told if sums.told > 0.5 * rows else math.inf
        value = _compensated(sums, biased, scale)
        return _Fit(span_s, value, inverse, A, left, energy, rows, expected)


def _compensated(sums: _Block, biased: F64, scale: F64) -> F64:
    """The coefficients without the bias that noise in the regressors makes: (A − N) θ = b.

    Args:
        biased: the coefficients with it, shape (n,).
        scale: root of A's diagonal, shape (n,).
    """
    part = sums.noise / np.square(scale)
    most = float(part.max())
    if not _LEAST_NOISE < most < _MOST_NOISE:
        return biased
    signal = sums.gram[:-1, :-1] / (scale[:, None] * scale)
    signal.flat[:: len(scale) + 1] -= part
    if eigenvalues(signal)[0] <= 1e-8:
        return biased
    return np.asarray(np.linalg.solve(signal, sums.gram[:-1, -1] / scale) / scale)


def _excludes(shortest: _Fit, value: F64) -> bool:
    """Whether the shortest window's rows cannot be of a motor with these coefficients: their cost rises by more than
    chance and an error of the model make of it."""
    n = len(value)
    off = value - shortest.value
    cost = float(off @ shortest.information @ off)
    scale = OVERLAP * shortest.residual_var + SYSTEMATIC**2 * shortest.energy
    return cost > scale * (n + _CHANCE_STDS * math.sqrt(2.0 * n))


def _structure(fit: _Fit, quiet: _Fit) -> float:
    """Σ of squares that a window's best fit leaves beyond noise.

    Args:
        quiet: the rows with the least residual: noise is no larger than there.
    """
    by_noise = _noise(fit.rows, fit.energy, quiet, quiet.chance)
    told = fit.expected * (1.0 + fit.chance) + CLOSES**2 * fit.energy
    return max(0.0, fit.left - min(by_noise, told))


def _unexplained(newest: _Block, value: F64, shortest: _Fit, quiet: _Fit) -> float:
    """Σ of squares that coefficients leave of the newest rows beyond noise, as if all of the shortest window's rows
    were as far off: a motor that has changed a moment ago."""
    rows = newest.rows
    weights = np.append(-value, 1.0)
    left = float(weights @ newest.gram @ weights)
    chance = _CHANCE_STDS * math.sqrt(2.0 * OVERLAP / rows)
    return max(0.0, left - _noise(rows, float(newest.gram[-1, -1]), quiet, chance)) * max(shortest.rows / rows, 1.0)


def _noise(rows: float, energy: float, quiet: _Fit, chance: float) -> float:
    """Σ of squares that noise may leave of rows, and an error of the model that goes with their size.

    Args:
        energy: Σ y².
        chance: how much more of it there may be, as a share.
    """
    return _LEVEL_VARIES * rows * quiet.residual_var * (1.0 + chance) + (2.0 * SYSTEMATIC) ** 2 * energy
