"""Knowledge of parameters from elsewhere, taken into a running filter as a measurement."""

from __future__ import annotations

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.samples import F64


def assimilate(ekf: Ekf, known: Gaussian, widen_std: F64) -> None:
    """The filter's states and other parameters follow by their correlations.

    Args:
        known: of some of the filter's coordinates.
        widen_std: added to the filter's own 1 σ of these first, shape (k,).
    """
    names = ekf.plant.parameter_names
    at = [names.index(n) for n in known.names]
    which, mean, widen = np.zeros(len(names), dtype=bool), np.zeros(len(names)), np.zeros(len(names))
    covariance = np.zeros((len(names), len(names)))
    which[at], mean[at], widen[at] = True, known.mean, np.square(widen_std)
    covariance[np.ix_(at, at)] = known.covariance
    if widen.any():
        ekf.widen_parameters(widen)
    ekf.recall(which, mean, covariance)
