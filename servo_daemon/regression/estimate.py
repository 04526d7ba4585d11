"""What the regressions found, and the steps from their coefficients to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.regression.columns.terms import is_share
from servo_daemon.samples import F64

#: A regression knows a parameter when its std is below this share of it (free within a half and twice:
#: tests/recovery/constants.py).
KNOWS = 0.25


@dataclass(frozen=True, slots=True)
class RegressionEstimate:
    """Parameters in natural units: value shape (n,), covariance shape (n, n). Values may come out impossible.

    Attributes:
        span_s: how far back the regressions look.
        closes: the balances leave nothing beyond their noise.
        unseen_std: what the samples are too slow to show, in natural units, shape (n,); None: nothing. Not in the
            covariance: whether two opinions agree is asked with `sampling.blind_std`.
    """

    names: tuple[str, ...]
    value: F64
    covariance: F64
    span_s: float
    closes: bool
    unseen_std: F64 | None = None

    @property
    def std(self) -> F64:
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    def knows(self, name: str) -> bool:
        """Whether it gives a parameter, and better than to `KNOWS`."""
        if name not in self.names:
            return False
        k = self.names.index(name)
        return bool(self.std[k] < KNOWS * self.value[k])

    @property
    def with_unseen(self) -> RegressionEstimate:
        """The same with all that it leaves open in its covariance."""
        if self.unseen_std is None:
            return self
        return replace(self, covariance=self.covariance + np.diag(self.unseen_std**2), unseen_std=None)


def as_current(value: F64, covariance: F64, k: int) -> tuple[F64, F64]:
    """(R, …, i0, …) where coefficient k is the voltage −R i0, errors to first order; R is the first."""
    R, constant_V = float(value[0]), float(value[k])
    if R == 0.0:
        return value, covariance
    out, by = value.copy(), np.eye(len(value))
    out[k] = -constant_V / R
    by[k, 0], by[k, k] = constant_V / R**2, -1.0 / R
    return out, by @ covariance @ by.T


def side_by_side(covariances: list[F64]) -> F64:
    """Of estimates that are independent of each other: a block diagonal matrix (`scipy.linalg.block_diag` at a fifth
    of its time: two small blocks with every update)."""
    ends = np.cumsum([len(c) for c in covariances]).tolist()
    out = np.zeros((ends[-1], ends[-1]))
    for end, c in zip(ends, covariances, strict=True):
        out[end - len(c) : end, end - len(c) : end] = c
    return out


def times_torque_constant(value: F64, covariance: F64, names: Sequence[str], n_armature: int) -> tuple[F64, F64]:
    """Shaft coefficients (those after the armature's) were found per unit of K (the third value): multiply, errors
    included to first order. A share of the torque is one of the current as well."""
    K = value[2]
    per_K = np.array([k >= n_armature and not is_share(name) for k, name in enumerate(names)])
    by = np.diag(np.where(per_K, K, 1.0))
    by[per_K, 2] = value[per_K]
    return np.where(per_K, K * value, value), by @ covariance @ by.T


def without_lag(value: F64, covariance: F64, lag_s: float) -> tuple[F64, F64]:
    """(J, B, …) where (v − K ω)/R stood for the current, which lags behind it by L/R: the coefficient of dω/dt was then
    J + B L/R (to first order in the lag)."""
    by = np.eye(len(value))
    by[0, 1] = -lag_s
    return by @ value, by @ covariance @ by.T
