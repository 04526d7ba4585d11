"""Rows of a regression that a wrong sample has spoilt are few and far off: they are left out.

Where many rows are far off it is not the samples that are wrong, and a balance without those rows would close.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from servo_daemon.numerics import median
from servo_daemon.samples import F64

#: So many rows' residuals are remembered; below the second number nothing is left out (chosen; free within half and
#: twice, the second moves no tracking figure).
_ROWS, _FEWEST = 200, 30
#: Far off: beyond so many median residuals, and this share (rms) of the balance (chosen; free within half and twice).
_MEDIANS, _SHARE = 12.0, 0.02
#: Most rows that may be far off (chosen; half and twice move no tracking figure).
_MOST_SPOILT = 0.1


@dataclass(slots=True)
class Plausible:
    """Remembers the residuals of one regression's last rows, and finds new rows that are far off."""

    _residuals: F64 = field(default_factory=lambda: np.empty(0))
    _squares: F64 = field(default_factory=lambda: np.empty(0))

    def rows(self, residual: F64, y: F64) -> NDArray[np.bool_]:
        """Which rows may be used, shape (m,).

        Args:
            residual, y: of the regression with its coefficients so far, shape (m,).
        """
        size = np.abs(residual)
        recent = self._residuals = np.concatenate([self._residuals, size])[-_ROWS:]
        self._squares = np.concatenate([self._squares, np.square(y)])[-_ROWS:]
        if len(recent) < _FEWEST:
            return np.ones(len(size), dtype=bool)
        limit = _MEDIANS * median(recent) + _SHARE * (float(self._squares.sum()) / len(recent)) ** 0.5
        if np.count_nonzero(recent > limit) > _MOST_SPOILT * len(recent):
            return np.ones(len(size), dtype=bool)
        return np.asarray(size <= limit)
