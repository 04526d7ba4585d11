"""Where mean and covariance of z = (x, q) are in the filter's flat state, and what is done with the two."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servo_daemon.kalman.layout import EkfLayout
from servo_daemon.samples import F64


class Moments:
    """Reads and writes mean and covariance in a filter's state.

    Attributes:
        parameters: where the covariance of the parameters' coordinates is, shape (n_q, n_q).
        variances, parameter_variances: where the variances are, shapes (n_z,) and (n_q,).
    """

    def __init__(self, layout: EkfLayout) -> None:
        self._lay = layout
        self._rows, self._columns = layout.triangle
        elements = np.empty((layout.n_z, layout.n_z), dtype=np.intp)
        elements[self._rows, self._columns] = np.arange(layout.tri.start, layout.tri.stop)
        elements[self._columns, self._rows] = elements[self._rows, self._columns]
        self._elements = elements
        self.parameters: NDArray[np.intp] = elements[layout.q, layout.q].copy()
        self.variances: NDArray[np.intp] = elements.diagonal().copy()
        self.parameter_variances: NDArray[np.intp] = self.variances[layout.q].copy()

    def of(self, state: F64) -> tuple[F64, F64]:
        """Copies of mean, shape (n_z,), and covariance, shape (n_z, n_z)."""
        return state[self._lay.z].copy(), state[self._elements]

    def put(self, state: F64, z: F64, P: F64) -> None:
        """Write mean and covariance into a state."""
        state[self._lay.z] = z
        state[self._lay.tri] = P[self._rows, self._columns]


def set_apart(P: F64, index: list[int], own: F64) -> None:
    """What is known of some elements has nothing to do with the rest any more; P is changed in place.

    Args:
        own: their covariance from now on, shape (k, k).
    """
    P[index, :] = 0.0
    P[:, index] = 0.0
    P[np.ix_(index, index)] = own


def conditioned(z: F64, P: F64, at: NDArray[np.intp], mean: F64, covariance: F64) -> tuple[F64, F64]:
    """Mean and covariance after a measurement of some elements, the covariance in Joseph's form.

    Args:
        at: which, shape (k,).
        mean, covariance: what is measured of these, shapes (k,) and (k, k).
    """
    S = P[np.ix_(at, at)] + covariance
    size = np.sqrt(np.diag(S))
    gain = np.linalg.solve(S / np.outer(size, size), P[at] / size[:, None]).T / size
    left = np.eye(len(z))
    left[:, at] -= gain
    after = left @ P @ left.T + gain @ covariance @ gain.T
    return z + gain @ (mean - z[at]), (after + after.T) / 2
