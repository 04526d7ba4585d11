"""What the drives of a type have in common: empirical Bayes over their parameters.

Each drive's parameters are drawn from one normal distribution (of the logarithm where a parameter is positive), and
what its captures say of them has the covariance of its fit:

    y_i = x_i + e_i,   x_i ~ N(μ, T),   e_i ~ N(0, S_i)

μ and T are found by expectation–maximisation (Dempster, Laird & Rubin 1977); what is then known of a drive is
E[x_i | y_i] with its covariance and that of μ (Efron & Morris 1975). Drives that do not belong to the others are found
with the weights of a t distribution (Lange, Little & Taylor 1989), left out of μ and T, and keep their own values; this
holds for up to about one drive in ten, 1/(ν + p) (Maronna 1976).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from servo_daemon.numerics import STD_OF_MEDIAN
from servo_daemon.samples import F64

#: With fewer drives T is hardly known, and its own error, which the interval leaves out, is as large as T.
FEWEST = 8
#: Chance that any drive of a fleet without strangers is called one (Bonferroni).
_STRANGER = 0.01
#: Degrees of freedom of the weights: what Lange et al. recommend where they are not estimated.
_NU = 4.0
#: Variance of a logarithm that says nothing (a factor of e^30 either way).
UNKNOWN = 1e3
_MOST_STEPS, _STEP_TOLERANCE = 500, 1e-6


@dataclass(frozen=True, slots=True)
class Prior:
    """Of n drives: mean, shape (p,), its covariance and the covariance T between drives, both of shape (p, p)."""

    mean: F64
    mean_cov: F64
    between: F64
    n: int


@dataclass(frozen=True, slots=True)
class Pooled:
    """What is known of each drive with the others beside it.

    Attributes:
        prior: of the drives that belong together.
        mean: shape (n, p); of a stranger its own values.
        cov: shape (n, p, p).
        stranger: shape (n,).
        distance: shape (n,), squared Mahalanobis distance of a drive's own values from μ.
    """

    prior: Prior
    mean: F64
    cov: F64
    stranger: NDArray[np.bool_]
    distance: F64


def pool(y: F64, S: F64) -> Pooled | None:
    """Values of all drives together; None where fewer than `FEWEST` of them belong together.

    Args:
        y: shape (n, p), each drive's own values.
        S: shape (n, p, p), their covariances; a variance of `UNKNOWN` for what a drive's captures do not determine.

    Raises:
        ValueError: the shapes do not fit.
    """
    n, p = y.shape
    if S.shape != (n, p, p):
        raise ValueError(f"covariances have shape {S.shape}, not {(n, p, p)}")
    if n < FEWEST:
        return None
    known = np.einsum("ikk->ik", S) < UNKNOWN
    mean, between = _maximised(y, S, robust=True)
    distance = _distance(y, S, mean, between)
    dof = np.maximum(known.sum(axis=1), 1)
    # A t distribution's T is a scale, not a covariance: the distances' median sets it.
    scale = float(np.median(distance / chi2.ppf(0.5, dof)))
    stranger = chi2.sf(distance / max(scale, 1.0), dof) < _STRANGER / n
    if np.count_nonzero(~stranger) < FEWEST:
        return None
    prior = _prior(y[~stranger], S[~stranger])
    inverse = np.linalg.inv(prior.between + S)
    gain, kept = prior.between @ inverse, S @ inverse
    own = stranger[:, None]
    pooled = prior.mean + np.einsum("ijk,ik->ij", gain, y - prior.mean)
    # Joseph's form: where drives differ by far more than each is known to, I - gain is rounding.
    cov = kept @ (prior.between + prior.mean_cov) @ kept.transpose(0, 2, 1) + gain @ S @ gain.transpose(0, 2, 1)
    return Pooled(
        prior,
        np.where(own, y, pooled),
        np.where(own[:, :, None], S, 0.5 * (cov + cov.transpose(0, 2, 1))),
        stranger,
        _distance(y, S, prior.mean, prior.between),
    )


def _prior(y: F64, S: F64) -> Prior:
    n = len(y)
    mean, between = _maximised(y, S, robust=False)
    between = between * n / (n - 1)  # of maximum likelihood's bias, as that of a sample's variance
    mean_cov = np.linalg.inv(np.linalg.inv(between + S).sum(axis=0))
    return Prior(mean, mean_cov, between, n)


def _maximised(y: F64, S: F64, *, robust: bool) -> tuple[F64, F64]:
    """μ and T by expectation–maximisation; `robust`: those of a t distribution of `_NU` degrees of freedom."""
    n, p = y.shape
    variance = np.einsum("ikk->ik", S)
    believed = np.where(variance < UNKNOWN, 1.0 / variance, 0.0)
    mean = _weighted_median(y, believed)
    spread = _weighted_median(np.abs(y - mean), believed)
    between = np.diag(np.maximum((STD_OF_MEDIAN * spread) ** 2, 1e-8))
    dof = np.maximum((believed > 0.0).sum(axis=1), 1)
    for _ in range(_MOST_STEPS):
        gain = between @ np.linalg.inv(between + S)
        each = mean + np.einsum("ijk,ik->ij", gain, y - mean)
        left = (np.eye(p) - gain) @ between
        weight = np.ones(n)
        if robust:
            weight = (_NU + dof) / (_NU + _distance(y, S, mean, between))
        new_mean = weight @ each / weight.sum()
        d = each - new_mean
        new = (np.einsum("i,ij,ik->jk", weight, d, d) + left.sum(axis=0)) / n
        new = 0.5 * (new + new.T)
        scale = np.sqrt(np.diag(new))
        moved = np.max(np.abs(new_mean - mean) / scale) + np.max(np.abs(np.sqrt(np.diag(between)) / scale - 1.0))
        mean, between = new_mean, new
        if moved < _STEP_TOLERANCE:
            break
    return mean, between


def _weighted_median(values: F64, weight: F64) -> F64:
    """Of each column, shape (p,)."""
    order = np.argsort(values, axis=0)
    sorted_values, sorted_weight = np.take_along_axis(values, order, 0), np.take_along_axis(weight, order, 0)
    part = np.cumsum(sorted_weight, axis=0)
    at = np.argmax(part >= 0.5 * part[-1], axis=0)
    return np.asarray(np.take_along_axis(sorted_values, at[None], 0)[0])


def _distance(y: F64, S: F64, mean: F64, between: F64) -> F64:
    """Squared Mahalanobis distances, shape (n,)."""
    d = y - mean
    return np.asarray(np.einsum("ij,ij->i", d, np.linalg.solve(between + S, d[:, :, None])[:, :, 0]))
