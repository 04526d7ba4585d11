"""Linear algebra of matrices of a few rows, where NumPy's wrappers take several times as long as LAPACK itself.

The same routines as NumPy's of the same purpose (`gesv`, `syevd`), called through SciPy: the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg.lapack import dgesv, dsyevd

from servo_daemon.samples import F64


def eigen(symmetric: F64) -> tuple[F64, F64]:
    """Eigenvalues, the smallest first, shape (n,), and eigenvectors as columns, shape (n, n)."""
    values, vectors, failed = dsyevd(symmetric, lower=1)
    _check(failed)
    return values, vectors


def eigenvalues(symmetric: F64) -> F64:
    """The smallest first, shape (n,)."""
    values, _, failed = dsyevd(symmetric, compute_v=0, lower=1)
    _check(failed)
    return np.asarray(values)


def solved(matrix: F64, right: F64) -> F64:
    """x of `matrix` x = `right`; right: shape (n,) or (n, m)."""
    _, _, x, failed = dgesv(matrix, right)
    _check(failed)
    return np.asarray(x)


def inverse(matrix: F64) -> F64:
    """Shape (n, n)."""
    return np.ascontiguousarray(solved(matrix, np.eye(len(matrix))))


def in_columns(columns: Sequence[F64]) -> F64:
    """Arrays of shape (m,) as the columns of one, shape (m, n)."""
    out = np.empty((len(columns[0]), len(columns)))
    for k, column in enumerate(columns):
        out[:, k] = column
    return out


def _check(failed: int) -> None:
    if failed:
        raise np.linalg.LinAlgError(f"LAPACK: no solution ({failed})")
