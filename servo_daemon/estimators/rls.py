"""Recursive least squares that says how old it is: y = Φ θ + e with several exponential memories side by side.

Each memory M keeps the sums of its rows, weighted by exp(−age/M), in information form (A = Σ ΦᵀΦ, b = Σ Φᵀy, c = Σ y²):

    θ = A⁻¹ b,   residual = c − bᵀ θ

All directions forget alike, so nothing that is known is older than a few memories, however little of it the motion
shows now (directional forgetting keeps what is not excited, and with it a motor of minutes ago).

A long memory averages noise, a short one follows a motor that changes. Which of them to believe the rows decide: a
memory across which the motor has changed closes its balance worse than a shorter one. What it leaves beyond the noise
may lie along any parameter's term (Cauchy–Schwarz: the bias is at most √((A⁻¹)ₖₖ Σ e²)), and stands in its covariance;
the memory with the smallest standard deviations is the estimate, unless the shortest one excludes it (bias against
variance by the data themselves: Lepski, *Theory Probab. Appl.* 35, 1991; Goldenshluger & Nemirovski, *Math. Methods
Statist.* 6, 1997). The newest rows by themselves are held against it as well, so that a step is doubted at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.estimators.small_matrices import eigen, eigenvalues
from servo_daemon.samples import F64

#: s. The longest averages what noise there is and spans a slow motion's period; the shortest still holds enough rows of
#: the shaft (25) to tell five coefficients. `benchmarks.tracking witness`: with a fourth or fifth between them, or
#: 1, 3 and 10 s, the errors under ageing are the same within a tenth.
MEMORIES_S = (1.25, 5.0, 20.0)
#: By how much the model of a row may be off, as a share of y: dead time, ripple, friction that is not quite viscous.
SYSTEMATIC = 1e-3
#: No variance is smaller.
_TINY = 1e-300
#: A balance that closes to this share (rms) closes: its parameters change while it is summed up, and integrals over
#: samples are no more exact.
CLOSES = 0.01
#: Windows overlap by half, so neighbouring rows share half their noise: covariances are that much too small.
OVERLAP = 2.0
#: Noise is compensated only while it is a smaller part of every regressor than this.
_MOST_NOISE = 0.3
#: A column this much smaller than the largest is zero: no units of motors differ by as much.
_INVISIBLE = 1e-12
#: Least information of a direction, each column over its own size: rounding is smaller, and two columns that are the
#: same (friction and load of a motor that turns one way) leave only their own coefficients unknown.
_LEAST_SHARE = 1e-9
#: Fewest rows for each coefficient.
_ROWS_PER_COEFFICIENT = 2.0
#: A sum of squares is larger than expected, and a memory excluded, beyond so many standard deviations of what chance
#: makes of it.
_CHANCE_STDS = 4.0
#: A sum of squares is no smaller than this share of y's: rounding.
_EXACT = 1e-15


@dataclass(frozen=True, slots=True)
class LinearEstimate:
    """θ of y = Φ θ: value shape (n,), covariance shape (n, n), and the variance of one row's error.

    The covariance holds the noise, which averages out, and what does not: an error of the model of the share
    `SYSTEMATIC` of y, as if it stood in every row in the worst way, and what the rows leave beyond their noise. Where a
    regressor is nothing but noise (its coefficient is then drawn towards zero, as always with errors in variables), it
    is this that says so.

    Attributes:
        memory_s: how far back the estimate looks.
    """

    value: F64
    covariance: F64
    residual_var: float
    memory_s: float


@dataclass(frozen=True, slots=True)
class _Fit:
    """Of one memory: value shape (n,), inverse and information shape (n, n).

    Attributes:
        left, energy: Σ of squares that the fit leaves of y, and of y.
        rows: how many, as weighted.
        expected: of what is left, what the sensors' noise explains; infinite where it is not known.
    """

    memory_s: float
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


class AdaptiveRls:
    """Fed blocks of rows.

    Args:
        n: number of coefficients.
        rows_per_s: how many a second has where none is missing: the memories count rows.
        memories_s: increasing.

    Attributes:
        rows: how many there were.
    """

    def __init__(self, n: int, rows_per_s: float, memories_s: Sequence[float] = MEMORIES_S) -> None:
        self._n, self._memories_s = n, tuple(memories_s)
        self._per_row = 1.0 / (rows_per_s * np.array(memories_s))
        self._gram = np.zeros((len(memories_s), n + 1, n + 1))
        self._noise = np.zeros((len(memories_s), n, n))
        self._weight, self._told, self._expected = np.zeros((3, len(memories_s)))
        self._estimate: LinearEstimate | None = None
        self.rows = 0

    def update(self, gram: F64, m: int, noise: F64 | None = None, expected: float | None = None) -> None:
        """Take rows. Such as are not finite must not be among them.

        Args:
            gram: of [Φ | y], shape (n + 1, n + 1).
            m: how many rows.
            noise: what of ΦᵀΦ is noise of the regressors, shape (n, n): compensated in the estimate (bias-compensated
                least squares; Stoica & Söderström, *Automatica* 18, 1982), as far as it is the smaller part.
            expected: Σ of squares that the sensors' noise leaves of these rows at the most; None: not known.
        """
        if m == 0:
            return
        keep = np.exp(-m * self._per_row)
        self._gram = keep[:, None, None] * self._gram + gram
        self._noise = keep[:, None, None] * self._noise + (0.0 if noise is None else noise)
        self._weight = keep * self._weight + m
        self._told = keep * self._told + (0 if expected is None else m)
        self._expected = keep * self._expected + (expected or 0.0)
        self.rows += m
        self._estimate = self._best(gram, m)

    @property
    def value(self) -> F64 | None:
        """The coefficients so far, shape (n,); None as for `estimate`."""
        return None if self._estimate is None else self._estimate.value

    def estimate(self) -> LinearEstimate | None:
        """None until there are more rows than coefficients, and where some direction is not seen."""
        return self._estimate

    def _best(self, newest: F64, m: int) -> LinearEstimate | None:
        """Of the memory that is known best, with what it leaves unexplained.

        Args:
            newest: Gram matrix of the last m rows.
        """
        fits = [fit for k in range(len(self._memories_s)) if (fit := self._fit(k)) is not None]
        if not fits:
            return None
        quiet = min(fits, key=lambda fit: fit.residual_var)
        best: LinearEstimate | None = None
        least = math.inf
        for fit in fits:
            if _excludes(fits[0], fit.value):
                continue
            covariance = _covariance(fit, quiet) + fits[0].inverse * _unexplained(newest, m, fit, fits[0], quiet)
            spread = float(np.log(np.maximum(covariance.diagonal(), _TINY)).sum())
            if spread < least:
                least, best = spread, LinearEstimate(fit.value, covariance, fit.residual_var, fit.memory_s)
        return best

    def _fit(self, k: int) -> _Fit | None:
        n, weight = self._n, float(self._weight[k])
        A, b, energy = self._gram[k, :n, :n], self._gram[k, :n, n], float(self._gram[k, n, n])
        scale = np.sqrt(A.diagonal())
        # A regressor that is (all but) zero: also one that was in the beginning and is dying away.
        if weight <= _ROWS_PER_COEFFICIENT * n or scale.min() < _INVISIBLE * max(float(scale.max()), 1e-7):
            return None
        square = scale[:, None] * scale
        values, vectors = eigen(A / square)
        inverse = (vectors / np.maximum(values, _LEAST_SHARE)) @ vectors.T / square
        biased = inverse @ b
        left = max(energy - float(b @ biased), _EXACT * energy)
        known = self._told[k] > 0.5 * weight
        expected = float(self._expected[k]) * weight / float(self._told[k]) if known else math.inf
        value = self._compensated(k, biased, scale)
        return _Fit(self._memories_s[k], value, inverse, A, left, energy, weight, expected)

    def _compensated(self, k: int, biased: F64, scale: F64) -> F64:
        """The coefficients without the bias that noise in the regressors makes: (A − N) θ = b."""
        A, noise = self._gram[k, :-1, :-1], self._noise[k]
        part = noise.diagonal() / np.square(scale)
        signal = (A - noise) / (scale[:, None] * scale)
        if part.max() > _MOST_NOISE or eigenvalues(signal)[0] <= 1e-8:
            return biased
        return np.asarray(np.linalg.solve(signal, self._gram[k, :-1, -1] / scale) / scale)


def _excludes(shortest: _Fit, value: F64) -> bool:
    """Whether the shortest memory's rows cannot be of a motor with these coefficients: their cost rises by more than
    chance and an error of the model make of it."""
    n = len(value)
    off = value - shortest.value
    cost = float(off @ shortest.information @ off)
    scale = OVERLAP * shortest.residual_var + SYSTEMATIC**2 * shortest.energy
    return cost > scale * (n + _CHANCE_STDS * math.sqrt(2.0 * n))


def _covariance(fit: _Fit, quiet: _Fit) -> F64:
    """Of a memory's coefficients.

    Args:
        quiet: the memory with the least residual: noise is no larger than there.
    """
    by_noise = fit.rows * quiet.residual_var * (1.0 + quiet.chance)
    told = fit.expected * (1.0 + fit.chance) + CLOSES**2 * fit.energy
    structure = max(0.0, fit.left - min(by_noise, told))
    return fit.inverse * (fit.residual_var + SYSTEMATIC**2 * fit.energy + structure)


def _unexplained(newest: F64, m: int, fit: _Fit, shortest: _Fit, quiet: _Fit) -> float:
    """Σ of squares that coefficients leave of the newest rows beyond noise, as if all of the shortest memory's rows
    were as far off: a motor that has changed a moment ago.

    Args:
        newest: Gram matrix of [Φ | y] over the last m rows.
    """
    weights = np.append(-fit.value, 1.0)
    left = float(weights @ newest @ weights)
    by_chance = m * quiet.residual_var * (1.0 + _CHANCE_STDS * math.sqrt(2.0 * OVERLAP / m))
    exact = _CHANCE_STDS * SYSTEMATIC**2 * float(newest[-1, -1])
    return max(0.0, left - by_chance - exact) * max(shortest.rows / m, 1.0)
