"""The leave-one-group-out error of a GRNN over its bandwidths, with its gradient.

Without the windows of i's own motor g(i), the GRNN's answer at a training window is

    f_i = Σ_j p_ij y_j,   p_ij = w_ij / Σ_j w_ij,   w_ij = exp(−½ Σ_k (x_ik − x_jk)²/h_k²),   j not of g(i)

and E = Σ_i |y_i − f_i|². With r = y − f and A_ij = p_ij r_i·(y_j − f_i)

    ∂E/∂log h_k = −(2/h_k²) Σ_ij A_ij (x_ik − x_jk)²,

a handful of matrix products for all k together (leave-one-out for kernel regression: Härdle, *Applied Nonparametric
Regression*, 1990, ch. 5; the gradient is ours).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64

#: log h of standardised features: from a twentieth of their spread to where a feature no longer matters.
_LOG_RANGE = (-3.0, 5.0)


class LeaveOneOut:
    """E and its gradient for given windows.

    Args:
        X: shape (n, d), standardised.
        y: shape (n, m), standardised.
        groups: shape (n,): windows of one motor share a number.
    """

    def __init__(self, X: F64, y: F64, groups: NDArray[np.int64]) -> None:
        self._X, self._y = X, y
        self._own = groups[:, None] == groups[None, :]

    def error(self, log_h: F64) -> tuple[float, F64]:
        """Mean squared error per output, and its gradient by log h, shape (d,)."""
        X, y = self._X, self._y
        Z = X * np.exp(-log_h)
        squares = np.square(Z)
        p = kernel(square_distances(Z, Z, squares.sum(axis=1)), self._own)
        p /= p.sum(axis=1, keepdims=True)
        f = p @ y
        r = y - f
        A = p * (r @ y.T - np.einsum("im,im->i", r, f)[:, None])
        rows, columns = A.sum(axis=1), A.sum(axis=0)
        # Σ_ij A_ij (z_ik − z_jk)², by the three terms of the square
        spread = rows @ squares + columns @ squares - 2.0 * np.einsum("ik,ik->k", Z, A @ Z)
        return float(np.sum(r * r)) / r.size, -2.0 * spread / r.size


def square_distances(a: F64, b: F64, b_square: F64) -> F64:
    """|a_i − b_j|², shape (len(a), len(b)), with |b_j|², shape (len(b),)."""
    d = (-2.0 * a) @ b.T
    d += np.square(a).sum(axis=1)[:, None]
    d += b_square
    return np.asarray(np.maximum(d, 0.0, out=d))


def kernel(d2: F64, masked: NDArray[np.bool_] | None = None) -> F64:
    """exp(−½ d²) relative to each row's nearest, so that no row is all zero; in place of d2, shape kept.

    Args:
        masked: entries that count for nothing.
    """
    if masked is not None:
        d2[masked] = np.inf
    d2 -= d2.min(axis=1, keepdims=True)
    d2 *= -0.5
    return np.asarray(np.exp(d2, out=d2))


def fit_bandwidths(X: F64, y: F64, groups: NDArray[np.int64], max_iter: int) -> tuple[F64, int]:
    """h, shape (d,), and how many iterations that took: first one for all features by trial, from there each its own by
    L-BFGS-B.

    Args:
        X, y, groups: as for `LeaveOneOut`, at least two groups.
    """
    from scipy.optimize import minimize

    loo = LeaveOneOut(X, y, groups)
    d = X.shape[1]
    trials = np.log(np.sqrt(d)) + np.linspace(-2.0, 1.0, 7)
    errors = [loo.error(np.full(d, t))[0] for t in trials]
    start = np.clip(np.full(d, trials[int(np.argmin(errors))]), *_LOG_RANGE)
    found = minimize(
        loo.error, start, jac=True, method="L-BFGS-B", bounds=[_LOG_RANGE] * d, options={"maxiter": max_iter}
    )
    return np.asarray(np.exp(found.x if found.fun <= min(errors) else start)), max(1, int(found.nit))
