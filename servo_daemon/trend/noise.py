"""Serial correlation: what the noise of a series may be, white and in excursions of days to months."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from servo_daemon.samples import F64

#: Shares of the noise's variance in excursions, and how long these last, days. What lies between changes the evidence
#: of a series of 160 values by less than 1.
_SHARES: Final = (0.3, 0.6, 0.9)
_LASTING_D: Final = (4.0, 12.0, 36.0, 108.0)


@dataclass(frozen=True, slots=True)
class Noise:
    """Correlation of a series' noise, by its Cholesky factor; shape (n, n), lower."""

    share: float
    lasting_d: float
    factor: F64

    @property
    def log_det(self) -> float:
        """Half the logarithm of the correlation's determinant."""
        return float(np.log(np.diag(self.factor)).sum())

    def whitened(self, columns: F64) -> F64:
        return np.asarray(solve_triangular(self.factor, columns, lower=True, check_finite=False))


def noises(time_d: F64, days: F64) -> Iterator[Noise]:
    """White alone, and with excursions.

    Args:
        time_d, days: as in `Series`.
    """
    white = np.diag(np.median(days) / days)
    yield Noise(0.0, 0.0, np.sqrt(white))
    apart = np.abs(time_d[:, None] - time_d)
    for lasting_d in _LASTING_D:
        excursions = np.exp(-apart / lasting_d)
        for share in _SHARES:
            factor: F64 = np.asarray(np.linalg.cholesky((1.0 - share) * white + share * excursions), dtype=np.float64)
            yield Noise(share, lasting_d, factor)
