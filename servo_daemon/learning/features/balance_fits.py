"""Least squares of many models on the rows of one balance: all products of its columns are formed once, and every model
is a small set of normal equations taken from them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.numerics import STD_OF_MEDIAN, median
from servo_daemon.samples import F64

#: A model: which columns explain, and which one is explained.
Case = tuple[Sequence[int], int]
#: Ridge, added to the squares of unit columns: collinear columns then share what they explain.
_RIDGE = 1e-10
#: Outliers: rows beyond six robust standard deviations, rejected in so many rounds.
_REJECT, _REJECTIONS = 6.0 * STD_OF_MEDIAN, 3


@dataclass(frozen=True, slots=True)
class Fit:
    """Coefficients, and |residual| / |y|; NaN where there are too few rows."""

    theta: F64
    left: float


class Fits:
    """Products of a balance's columns, and the fits of models made of some of them.

    Args:
        columns: c of them, shapes (rows,): regressors, and what is to be explained by them.
    """

    def __init__(self, columns: Sequence[F64]) -> None:
        self._columns = np.array([*columns, np.zeros_like(columns[0])])  # the last stands where a model has fewer
        self._size = np.sqrt(np.einsum("cr,cr->c", self._columns, self._columns))
        self._size[self._size == 0.0] = 1.0
        self._columns /= self._size[:, None]
        self._gram = self._columns @ self._columns.T

    def solve(self, cases: Sequence[Case]) -> list[Fit]:
        """The fit of each case."""
        none, most = len(self._columns) - 1, max(len(own) for own, _ in cases)
        own = np.array([(*of, *(none,) * (most - len(of))) for of, _ in cases])
        y, case = np.array([y for _, y in cases]), np.arange(len(cases))
        gram = self._gram[own[:, :, None], own[:, None, :]]
        gram[:, range(most), range(most)] += _RIDGE
        theta = np.linalg.solve(gram, self._gram[own, y[:, None]][:, :, None])[:, :, 0]
        combined = np.zeros((len(cases), len(self._columns)))
        combined[case[:, None], own] = -theta
        combined[case, y] = 1.0
        residual = combined @ self._columns
        left = np.sqrt(np.einsum("cr,cr->c", residual, residual)).tolist()
        theta *= self._size[y][:, None] / self._size[own]
        rows = self._columns.shape[1]
        return [
            Fit(theta[k, : len(of)], left[k]) if rows > 2 * len(of) else Fit(np.full(len(of), np.nan), math.nan)
            for k, (of, _) in enumerate(cases)
        ]

    def rejected(self, own: Sequence[int], y: int) -> float:
        """Norm of the outliers' residuals over |y|, of a fit without them: large where something happened once (a
        voltage lost, a count slipped), which a fit to all rows would spread over all of them.

        Rows beyond 6 robust standard deviations (1.4826 × the median magnitude) are left out, three times.
        """
        A, wanted = self._columns[list(own)], self._columns[y]
        kept = np.ones(len(wanted), dtype=bool)
        left = np.zeros(len(wanted))
        for _ in range(_REJECTIONS):
            theta = _coefficients(A, wanted, kept)
            if theta is None:
                return math.nan
            left = np.abs(wanted - theta @ A)
            kept = left <= _REJECT * median(left) + 1e-300
        away = left[~kept]
        return float(np.sqrt(away @ away))


def fit(columns: Sequence[F64], y: F64) -> Fit:
    """Least squares of y on these columns."""
    own = range(len(columns))
    return Fits([*columns, y]).solve([(own, len(columns))])[0]


def _coefficients(A: F64, y: F64, kept: NDArray[np.bool_]) -> F64 | None:
    """Least squares of y on the columns A, shape (c, rows), over the rows that are kept; None: too few rows."""
    if np.count_nonzero(kept) <= 2 * len(A):
        return None
    own = A * kept
    gram = own @ A.T
    size = np.sqrt(gram.diagonal())
    size[size == 0.0] = 1.0
    gram /= np.outer(size, size)
    gram.flat[:: len(gram) + 1] += _RIDGE
    return np.asarray(np.linalg.solve(gram, own @ y / size) / size)
