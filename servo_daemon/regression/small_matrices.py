"""Linear algebra of matrices of a few rows, where NumPy's wrappers take several times as long as LAPACK itself.

The same routine as NumPy's (`syevd`), called through SciPy where a program has loaded that (the live estimator has; a
fit takes a sixth longer for it): the same numbers, bit for bit. (`gesv` is not: from six rows on SciPy's library rounds
differently, and the gain is below one per cent of a tick.)
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from servo_daemon.samples import F64

_LAPACK = "scipy.linalg.lapack"


def eigen(symmetric: F64) -> tuple[F64, F64]:
    """Eigenvalues, the smallest first, shape (n,), and eigenvectors as columns, shape (n, n)."""
    lapack = sys.modules.get(_LAPACK)
    if lapack is None:
        values, vectors = np.linalg.eigh(symmetric)
    else:
        values, vectors, failed = lapack.dsyevd(symmetric, lower=1)
        _check(failed)
    return values, np.ascontiguousarray(vectors)  # as NumPy has them: sums over rows keep their order


def eigenvalues(symmetric: F64) -> F64:
    """Eigenvalues of a symmetric matrix, the smallest first, shape (n,)."""
    lapack = sys.modules.get(_LAPACK)
    if lapack is None:
        return np.asarray(np.linalg.eigvalsh(symmetric))
    values, _, failed = lapack.dsyevd(symmetric, compute_v=0, lower=1)
    _check(failed)
    return np.asarray(values)


def in_columns(columns: Sequence[F64]) -> F64:
    """Arrays of shape (m,) as the columns of one, shape (m, n)."""
    out = np.empty((len(columns[0]), len(columns)))
    for k, column in enumerate(columns):
        out[:, k] = column
    return out


def _check(failed: int) -> None:
    if failed:
        raise np.linalg.LinAlgError(f"LAPACK: no solution ({failed})")
