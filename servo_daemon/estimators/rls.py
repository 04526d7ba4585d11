"""Recursive least squares with directional forgetting, and the two regressions of the servo on top of it.

The recursion keeps the information matrix. New information ΔA is compared with what is there, direction by direction
(generalised eigenvalues g of ΔA against A): a direction forgets only as fast as it learns,

    A⁺ = L V diag(max(λ, 1 − g) + g) Vᵀ Lᵀ,   A = L Lᵀ,  L⁻¹ ΔA L⁻ᵀ = V diag(g) Vᵀ

so that it neither winds up nor winds down when the motion says nothing (the aim of Kulhavý & Kárný 1984; Cao &
Schwartz, *Automatica* 36, 2000, in the symmetric form). The matrix can never become indefinite: it is a sum of squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dsyevd, dsygst  # a tick's matrices are too small for NumPy's own wrappers

from servo_daemon.estimators.small_matrices import eigen, eigenvalues
from servo_daemon.samples import F64

#: Information of the start, relative to the first rows: enough for a Cholesky factor, too little to pull.
_START_INFORMATION = 1e-9
#: A regressor that is zero at first is told from nothing from this share of the largest one's square on: a filter's
#: dying tail (1e-160) must not be divided by.
_LEAST_SEEN = 1e-20
#: By how much the model of a row may be off, as a share of y: dead time, ripple, friction that is not quite viscous.
SYSTEMATIC = 1e-3
#: Noise is compensated only while it is a smaller part of every regressor than this.
_MOST_NOISE = 0.3
#: A column this much smaller than the largest is zero: no units of motors differ by as much.
_INVISIBLE = 1e-12
#: Beyond this condition number, each column over its own size, the rows do not determine the coefficients.
_WORST_CONDITION = 1e10
#: Of a direction with less information than this, relative to the one with most, rounding errors are all there is.
_ROUNDING = 1e-11


@dataclass(frozen=True, slots=True)
class LinearEstimate:
    """θ of y = Φ θ: value shape (n,), covariance shape (n, n), and the variance of one row's error.

    The covariance holds the noise, which averages out, and an error of the model of the share `SYSTEMATIC` of y, which
    does not: as if it stood in every row in the worst way. Where a regressor is nothing but noise (its coefficient is
    then drawn towards zero, as always with errors in variables), it is this that says so.
    """

    value: F64
    covariance: F64
    residual_var: float


class DirectionalRls:
    """y = Φ θ + e, row by row or in blocks of rows.

    Args:
        n: number of coefficients.
        memory: rows after which an excited direction has forgotten about 63 %.
    """

    def __init__(self, n: int, memory: float) -> None:
        self._n, self._memory = n, memory
        self.reset()

    def reset(self) -> None:
        self._A = np.zeros((self._n, self._n))
        self._value = np.zeros(self._n)
        self._residual_sum = 0.0
        self._energy = 0.0  # Σ y², as weighted
        self._noise = np.zeros((self._n, self._n))
        self._weight = 0.0
        self.rows = 0

    @property
    def value(self) -> F64:
        """The coefficients so far, shape (n,); without the compensation of noise in the regressors."""
        return self._value

    def update(self, Phi: F64, y: F64, noise: F64 | None = None) -> None:
        """Take rows: Phi shape (m, n), y shape (m,). Rows that are not finite must not be passed.

        Args:
            noise: what of ΦᵀΦ is noise of the regressors, shape (n, n): compensated in the estimate (bias-compensated
                least squares; Stoica & Söderström, *Automatica* 18, 1982), as far as it is the smaller part.
        """
        m = len(y)
        if m == 0:
            return
        gained = Phi.T @ Phi
        if self.rows == 0:
            least = max(_LEAST_SEEN * float(gained.diagonal().max()), _LEAST_SEEN**1.5)
            self._A = np.diag(np.maximum(gained.diagonal(), least)) * _START_INFORMATION
        keep = math.exp(-m / self._memory)
        residual = y - Phi @ self._value
        kept, slowest = self._forget(gained, keep)
        A = kept + gained
        self._value = self._value + _least_step(A, Phi.T @ residual)
        after = y - Phi @ self._value
        self._A = (A + A.T) / 2
        # Errors before times errors after: by how much the least-squares cost rises (Ljung 1999, eq. 11.17).
        self._residual_sum = keep * self._residual_sum + float(residual @ after)
        # An error of the model is remembered as long as any direction remembers the rows it came with.
        self._energy = max(keep * self._energy + float(y @ y), slowest * self._energy)
        self._weight = keep * self._weight + m
        self._noise = keep * self._noise + (0.0 if noise is None else noise)
        self.rows += m

    def _forget(self, gained: F64, keep: float) -> tuple[F64, float]:
        """What is left of the old information when `gained` arrives, and of the direction that forgets least."""
        scale = np.sqrt(self._A.diagonal() + gained.diagonal() + 1e-300)
        square = scale[:, None] * scale
        A, G = self._A / square, gained / square
        A.flat[:: self._n + 1] += 1e-13
        L, failed = dpotrf(A, lower=1, clean=1)
        if failed:
            raise np.linalg.LinAlgError("the information matrix is not positive definite")
        between, _ = dsygst(G, L, lower=1)  # L⁻¹ ΔA L⁻ᵀ, its lower triangle
        g, V, _ = dsyevd(between, lower=1)
        factor = np.maximum(keep, 1.0 - np.maximum(g, 0.0))
        LV = L @ V
        return np.asarray((LV * factor) @ LV.T * square), min(float(factor.max()), 1.0)

    def estimate(self) -> LinearEstimate | None:
        """None until there are more rows than coefficients and every direction has been seen."""
        if self.rows <= 2 * self._n or self._weight <= self._n:
            return None
        scale = np.sqrt(self._A.diagonal())
        if scale.min() < _INVISIBLE * max(scale.max(), 1e-7):  # a regressor that is (all but) zero
            return None
        square = scale[:, None] * scale
        values, vectors = eigen(self._A / square)
        if values[-1] > _WORST_CONDITION * values[0]:
            return None
        variance = self._residual_sum / (self._weight - self._n)
        inverse = (vectors / values) @ vectors.T / square
        covariance = inverse * (variance + SYSTEMATIC**2 * self._energy)
        return LinearEstimate(self._compensated(), covariance, variance)

    def _compensated(self) -> F64:
        """The coefficients without the bias that noise in the regressors makes: (A − N) θ = A θ_LS."""
        squares = self._A.diagonal()
        part = self._noise.diagonal() / np.maximum(squares, 1e-300)
        scale = np.sqrt(squares)
        signal = (self._A - self._noise) / (scale[:, None] * scale)
        if part.max() > _MOST_NOISE or eigenvalues(signal)[0] <= 1e-8:
            return self._value.copy()
        return np.asarray(np.linalg.solve(signal, self._A @ self._value / scale) / scale)


def _least_step(A: F64, gradient: F64) -> F64:
    """A⁻¹ g, shape (n,), without a step along what no row has shown yet: it would be rounding errors over next to
    nothing, and what the following rows make of it would be taken for noise of theirs."""
    scale = np.sqrt(A.diagonal())
    shown = scale > _INVISIBLE * scale.max()
    inverse = np.where(shown, 1.0 / np.maximum(scale, 1e-300), 0.0)
    values, V, _ = dsyevd(A * (inverse[:, None] * inverse), lower=1)
    kept = values > _ROUNDING * values[-1]
    V = V[:, kept]
    return np.asarray(inverse * (V @ ((V.T @ (inverse * gradient)) / values[kept])))
