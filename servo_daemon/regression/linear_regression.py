"""Least squares for balances that are linear in their parameters, with the standard deviations that data deserve.

The residual of a balance on real data is not white: friction that the model lacks goes with the position, torque ripple
with the angle. (XᵀX)⁻¹ σ² then promises too much. Beside it stands the covariance for autocorrelated residuals (Newey &
West, *Econometrica* 55, 1987, with the bandwidth of Andrews, *Econometrica* 59, 1991, for a residual of first order).
And what an error of the model of a thousandth of the balance would do in the worst way, which no length of a capture
averages out: it decides, as in the tracker, whether a parameter is determined at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.regression import rls_fit
from servo_daemon.samples import F64

#: Share of a balance by which filtering and interpolation may be wrong: beside the model's (`rls_fit.SYSTEMATIC`) this
#: is in the standard deviation (chosen; half and twice move no tracking figure).
_METHOD_ERROR = 2e-4
#: Rows of `covariances`.
ROBUST, WHITE, SYSTEMATIC = range(3)
_SIGMA, _SYSTEMATIC = 2.0, 0.4
#: Singular values of the scaled regressors below this part of the largest: a direction that the data do not contain
#: (chosen; half and twice move no tracking figure).
_NULL = 1e-7
#: In such a direction a coefficient takes part from this weight on (chosen; half and twice move no tracking figure).
_TAKES_PART = 1e-3


@dataclass(frozen=True, slots=True)
class LinearFit:
    """Coefficients of y = X β + e.

    Attributes:
        names: length m, those that the data determine.
        value: shape (m,).
        covariances: shape (3, m, m): for a residual that is correlated from row to row; σ² (XᵀX)⁻¹; for an error of
            the model.
        residual: y − X β, shape (w,).
        relative_error: |e| / |y|.
        null_directions: combinations of coefficients that change nothing, each scaled to a greatest weight of 1.
    """

    names: tuple[str, ...]
    value: F64
    covariances: F64
    residual: F64
    relative_error: float
    null_directions: tuple[Mapping[str, float], ...]

    def is_unclear(self, name: str) -> bool:
        """Not determined (`is_determined`), of either sign."""
        if name not in self.names:
            return True
        k = self.names.index(name)
        return not is_determined(abs(float(self.value[k])), self.covariances[:, k, k])

    def is_seen(self, name: str) -> bool:
        """Determined and positive."""
        return not self.is_unclear(name) and bool(self.value[self.names.index(name)] > 0.0)


def is_determined(value: float, variances: F64, weight: float = 1.0) -> bool:
    """Whether a positive parameter is above 2 σ, and would change by less than 40 % by an error of the model.

    Args:
        variances: shape (3,), as in `LinearFit.covariances`.
        weight: the model's error counts so much less.
    """
    std = np.sqrt(np.maximum(variances, 0.0))
    return bool(value > max(_SIGMA * std[ROBUST], std[SYSTEMATIC] / weight / _SYSTEMATIC))


def fit_linear(names: Sequence[str], X: F64, y: F64, Z: F64 | None = None) -> LinearFit:
    """Least squares, or instrumental variables with instruments Z of X's shape: β = (ZᵀX)⁻¹ Zᵀy.

    Args:
        names: of the columns, length m.
        X: shape (w, m).
        y: shape (w,).

    Raises:
        BadInputError: fewer rows than coefficients.
    """
    if len(y) <= 2 * len(names):
        raise BadInputError(
            f"only {len(y)} filtered rows for {len(names)} coefficients: the capture is too short for this filter"
        )
    scale = np.sqrt(np.mean(X**2, axis=0))
    zero = scale == 0.0
    scale[zero] = 1.0
    directions = _null_directions(X / scale)
    lost = zero | (np.abs(directions) > _TAKES_PART).any(axis=0)
    keep = ~lost
    # Dropping all but one of each dependent group keeps the fit and gives none of its members a value.
    used = _independent(X / scale)
    A = X[:, used] / scale[used]
    W = A if Z is None else Z[:, used] / scale[used]
    inverse = np.linalg.inv(W.T @ A)
    beta = inverse @ (W.T @ y)
    residual = y - A @ beta
    s2 = float(residual @ residual) / (len(y) - A.shape[1])
    white = s2 * inverse @ (W.T @ W) @ inverse.T
    robust = inverse @ long_run(W * residual[:, None]) @ inverse.T
    worst = float(y @ y) * inverse @ (W.T @ W) @ inverse.T
    covariances = np.stack([robust + _METHOD_ERROR**2 * worst, white, rls_fit.SYSTEMATIC**2 * worst])
    out = np.flatnonzero(keep[used])
    back = 1.0 / scale[used][out]
    return LinearFit(
        names=tuple(names[k] for k in used if keep[k]),
        value=beta[out] * back,
        covariances=covariances[:, out[:, None], out] * np.outer(back, back),
        residual=residual,
        relative_error=float(np.linalg.norm(residual) / max(float(np.linalg.norm(y)), 1e-300)),
        null_directions=tuple(_named(names, d / scale) for d in directions),
    )


def _null_directions(A: F64) -> F64:
    """Unit vectors v with A v ≈ 0, shape (k, m)."""
    _, singular, vt = np.linalg.svd(A, full_matrices=False)
    return np.asarray(vt[singular < _NULL * max(float(singular[0]), 1e-300)])


def _independent(A: F64) -> list[int]:
    """Columns, first come first kept, that do not depend on the ones before (pivot-free Gram–Schmidt)."""
    used: list[int] = []
    for k in range(A.shape[1]):
        rest = A[:, k]
        if used:
            rest = rest - A[:, used] @ np.linalg.lstsq(A[:, used], rest, rcond=None)[0]
        if np.linalg.norm(rest) > 10 * _NULL * np.sqrt(len(A)):
            used.append(k)
    return used


def _named(names: Sequence[str], direction: F64) -> dict[str, float]:
    direction = direction / direction[np.argmax(np.abs(direction))]
    return {n: float(d) for n, d in zip(names, direction, strict=True) if abs(d) > _TAKES_PART}


def long_run(scores: F64) -> F64:
    """Covariance of Σ of the rows of scores, shape (w, m), whose rows are correlated: (m, m), positive semidefinite."""
    n = len(scores)
    lags = min(n // 4, bandwidth(scores))
    total = scores.T @ scores
    for k in range(1, lags + 1):
        cross = scores[k:].T @ scores[:-k] * (1 - k / (lags + 1))
        total += cross + cross.T
    return np.asarray(total)


def bandwidth(scores: F64) -> int:
    """Lags for Bartlett weights: 1.1447 (α n)^(1/3), α = 4 ρ²/(1 − ρ²)² with the largest ρ of the columns."""
    rho = max((abs(autocorrelation(column)) for column in scores.T), default=0.0)
    rho = min(rho, 0.97)
    return int(1.1447 * (4 * rho**2 / (1 - rho**2) ** 2 * len(scores)) ** (1 / 3)) + 1


def autocorrelation(series: F64) -> float:
    """Correlation of neighbours."""
    centred = series - series.mean()
    power = float(centred @ centred)
    return float(centred[1:] @ centred[:-1]) / power if power > 0 else 0.0
