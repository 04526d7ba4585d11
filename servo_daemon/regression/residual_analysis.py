"""Residual analysis: whether the balances close, and by how much the filter's values differ from theirs.

Two regressions (armature, shaft) see the same samples as the filter, but each only its own balance, with the measured
motion in place of a model of it. That makes them consistent where the filter is not: a torque that is in no model
biases the filter's R and K through the speed that it predicts; the armature's balance does not know of it. Two
questions follow.

1. *What does the best fit of a balance leave*, beyond the noise? A torque or a voltage that the model lacks. It may lie
   along any of the parameters' terms, and as large a share of the term may be wrong (`mismatch_std`).
2. *By how much do the filter's values differ from what the balance has to say*, and is that more than chance? With the
   residuals r = y − Φ θ of the values θ that the filter had when the rows came,

       δ = (A − N)⁻¹ (Φᵀ r + N θ),   A = ΦᵀΦ,   N: what the sensors' noise adds to it,

   is the filter's mean error over the window, as the balance sees it (the score test of Rao 1948, taken as an estimate;
   values that follow an ageing motor have none). A filter that is efficient if its model is right, beside a regression
   that is consistent in any case: their difference is a test of the model (Hausman, *Econometrica* 46, 1978). What of
   δ² chance does not explain is added to what is published (`unexplained_var`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.numerics import is_definite
from servo_daemon.regression.balances import Sums, added
from servo_daemon.regression.rls_fit import CLOSES, LEAST_SIGNAL, OVERLAP, SYSTEMATIC
from servo_daemon.samples import F64

#: Integrals over samples (trapezoids, jitter, what the current does between samples) are no more exact than this, 1 σ.
EXACT_STD = 0.01
#: A difference of so many standard deviations (squared) is chance (two of them: one Gaussian in twenty is beyond).
_CHANCE = 4.0


def residual_square(gram: F64) -> float:
    """Σ of squares that the best fit leaves of y. `gram`: of [Φ | y], shape (n + 1, n + 1)."""
    scale = _scale(gram)
    return _residual_square(gram, scale, _inverse(gram, scale))


def _residual_square(gram: F64, scale: F64, inverse: F64) -> float:
    b = gram[:-1, -1] / scale
    return max(0.0, float(gram[-1, -1] - b @ inverse @ b))


def structure(gram: F64, expected: float, usual: float = 0.0) -> float:
    """Of that, what is neither noise nor within the share to which a balance closes.

    Args:
        expected: how much of the fit's sum of squares noise explains.
        usual: sum of squares of y where the motion is as lively as it usually is.
    """
    return max(0.0, _structure(gram, residual_square(gram), expected) - CLOSES**2 * usual)


def _structure(gram: F64, left: float, expected: float) -> float:
    return max(0.0, left - expected - CLOSES**2 * float(gram[-1, -1]))


def mismatch_std(gram: F64, expected: float, slopes: Mapping[str, F64], followed: float = np.inf) -> dict[str, float]:
    """By how much each coordinate may be off because the balance does not close: 1 σ, if all that its best fit leaves,
    beyond the noise, were an error along that parameter's own term.

    Args:
        gram: of [Φ | y], shape (m + 1, m + 1).
        expected: how much of the fit's sum of squares noise explains.
        slopes: d residual / d coordinate, as weights on the columns.
        followed: what the filter's values leave that it had when the rows came: a motor that ages within the window
            closes its balance with those, and with no constant ones.
    """
    scale = _scale(gram)
    inverse = _inverse(gram, scale)
    left = _structure(gram, min(_residual_square(gram, scale, inverse), followed), expected)
    weights = np.abs(np.array(list(slopes.values()))[:, :-1])
    own = weights.argmax(axis=1)
    std = (np.sqrt(left * inverse.diagonal()) / scale)[own].tolist()
    sizes = weights.max(axis=1).tolist()
    return {name: s / size for name, s, size in zip(slopes, std, sizes, strict=True) if size > 0.0}


@dataclass(frozen=True, slots=True)
class Residuals:
    """Residuals of a balance's rows with the filter's values.

    Attributes:
        sums: of the rows.
        score: Φᵀ r + N θ, shape (n,).
        noise: N's diagonal, shape (n,).
        square: Σ r².
    """

    sums: Sums
    score: F64
    noise: F64
    square: float

    @classmethod
    def of(cls, sums: Sums, coefficients: F64, noise: F64) -> Residuals:
        """With the filter's values as coefficients of Φ, shape (n,), and N's diagonal, shape (n,)."""
        A, b, total = sums.gram[:-1, :-1], sums.gram[:-1, -1], float(sums.gram[-1, -1])
        square = total - 2.0 * float(b @ coefficients) + float(coefficients @ A @ coefficients)
        return cls(sums, b - A @ coefficients + noise * coefficients, noise, max(square, 0.0))


@dataclass(frozen=True, slots=True)
class MeanError:
    """By how much the filter's coefficients differ from a balance's, shape (n,), and the covariance of the latter."""

    error: F64
    covariance: F64


def mean_error(parts: list[Residuals]) -> MeanError | None:
    """Mean error over the rows of all parts; None where they do not determine the coefficients."""
    sums = Sums.total([p.sums for p in parts])
    if sums is None:
        return None
    n = len(sums.gram) - 1
    scale = _scale(sums.gram)
    square = scale[:, None] * scale
    signal = (sums.gram[:-1, :-1] - np.diag(added([p.noise for p in parts]))) / square
    if sums.rows <= 2 * n or not is_definite(signal, LEAST_SIGNAL):
        return None
    inverse = np.linalg.inv(signal) / square
    score = added([p.score for p in parts])
    error = inverse @ score
    left = max(0.0, sum(p.square for p in parts) - float(error @ score))
    spread = OVERLAP * left / (sums.rows - n) + SYSTEMATIC**2 * float(sums.gram[-1, -1])
    return MeanError(error, inverse * spread)


def unexplained_var(error: float, var: float) -> float:
    """What a difference of a logarithm from a balance's adds to its variance: its square, as far as it is not by
    chance.

    Args:
        var: of the difference.
    """
    return max(0.0, error**2 - _CHANCE * (var + EXACT_STD**2))


def _scale(gram: F64) -> F64:
    return np.asarray(np.sqrt(np.maximum(gram.diagonal()[:-1], 1e-300)))


def _inverse(gram: F64, scale: F64) -> F64:
    """Of ΦᵀΦ over its scale, slightly ridged."""
    scaled = gram[:-1, :-1] / (scale[:, None] * scale)
    scaled.flat[:: len(scale) + 1] += 1e-9
    return np.asarray(np.linalg.inv(scaled))
