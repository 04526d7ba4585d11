"""Rows of a regression that a wrong sample has spoilt are few and far off: they are left out.

Where many rows are far off it is not the samples that are wrong, and a balance without those rows would close.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64

#: So many rows' residuals are remembered; below the second number nothing is left out.
_ROWS, _FEWEST = 200, 30
#: Far off: beyond so many median residuals, and this share (rms) of the balance.
_MEDIANS, _SHARE = 12.0, 0.02
#: Most rows that may be far off.
_MOST_SPOILT = 0.1


@dataclass(slots=True)
class Plausible:
    """One regression's."""

    _residuals: deque[float] = field(default_factory=lambda: deque(maxlen=_ROWS))
    _squares: deque[float] = field(default_factory=lambda: deque(maxlen=_ROWS))

    def rows(self, residual: F64, y: F64) -> NDArray[np.bool_]:
        """Which rows may be used, shape (m,).

        Args:
            residual, y: of the regression with its coefficients so far, shape (m,).
        """
        size = np.abs(residual)
        self._residuals.extend(size.tolist())
        self._squares.extend(np.square(y).tolist())
        recent = np.array(self._residuals)
        limit = _MEDIANS * float(np.median(recent)) + _SHARE * float(np.mean(self._squares)) ** 0.5
        if len(recent) < _FEWEST or float(np.mean(recent > limit)) > _MOST_SPOILT:
            return np.ones(len(size), dtype=bool)
        return np.asarray(size <= limit)
