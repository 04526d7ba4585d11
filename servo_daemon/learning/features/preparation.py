"""Features as the learners take them: logarithms, gaps filled, each spread like a Gaussian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from sklearn.base import BaseEstimator

from servo_daemon.learning.features.features import transformed
from servo_daemon.samples import F64

#: Nothing is further out than this, in standard deviations, for a learner.
_FURTHEST = 3.0
#: A feature that so few windows have is none.
_LEAST_PRESENT = 0.5
#: Points of the distribution function that are kept of each feature.
_POINTS = 200
#: Windows are worked off so many at a time: bounds the comparisons with all points.
_ROWS = 64
#: Beyond the range of the training a feature counts on, for the familiarity: a tenth of the range as one standard
#: deviation, at most ten.
_PER_RANGE, _MOST_BEYOND = 10.0, 10.0


@dataclass(frozen=True)
class Prepared:
    """Of n windows and d used features.

    Attributes:
        learned: shape (n, d), within ± 3, for a learner.
        extended: shape (n, d): goes on beyond the training's range, for the familiarity.
        missing: shape (n,): share of the features that each window lacks.
    """

    learned: F64
    extended: F64
    missing: F64


class Preparation(BaseEstimator):  # type: ignore[misc]  # scikit-learn is untyped
    """Quantiles of each feature are turned into those of a Gaussian, because a kernel with one width for all windows
    needs them spread alike (of heavy tails it would see the tails only). scikit-learn's `QuantileTransformer` does the
    same and takes 30 ms for one window, which is too long for a daemon.

    Attributes:
        used_: indices of the features that vary and that most windows have.
        middle_: what stands for a missing one, shape (d,).
        points_: quantiles of each, as logarithms for positive features, shape (points, d).
        normal_: what they become, shape (points,).
    """

    def fit(self, X: F64) -> Preparation:
        """X: features in their units, shape (n, all), NaN where one cannot be had."""
        x = transformed(X)
        used = np.flatnonzero(np.isfinite(x).mean(axis=0) >= _LEAST_PRESENT)
        middle = np.nanmedian(x[:, used], axis=0)
        filled = np.where(np.isfinite(x[:, used]), x[:, used], middle)
        span = filled.max(axis=0) - filled.min(axis=0)
        varies = span > 1e-9 * (np.abs(filled).max(axis=0) + 1e-9)
        self.used_: NDArray[np.intp] = used[varies]
        self.middle_ = middle[varies]
        share = np.linspace(0.0, 1.0, _POINTS)
        self.points_ = np.quantile(filled[:, varies], share, axis=0)
        self.normal_ = np.clip(ndtri(np.clip(share, 1e-7, 1.0 - 1e-7)), -_FURTHEST, _FURTHEST)
        return self

    def transform(self, X: F64) -> F64:
        """For a learner, shape (n, d)."""
        return self.prepare(X).learned

    def prepare(self, X: F64) -> Prepared:
        """Features of windows in their units, shape (n, all)."""
        x = transformed(X)[:, self.used_]
        there = np.isfinite(x)
        x = np.where(there, x, self.middle_)
        learned = np.concatenate([self._gaussian(x[k : k + _ROWS]) for k in range(0, len(x), _ROWS)])
        lowest, highest = self.points_[0], self.points_[-1]
        beyond = np.maximum(x - highest, 0.0) - np.maximum(lowest - x, 0.0)
        extended = learned + np.clip(_PER_RANGE * beyond / (highest - lowest), -_MOST_BEYOND, _MOST_BEYOND)
        return Prepared(learned, extended, np.asarray((~there).mean(axis=1)))

    def _gaussian(self, x: F64) -> F64:
        """What values become, between the quantiles by interpolation, shape (n, d); all features at once."""
        points, normal, last = self.points_, self.normal_, len(self.normal_) - 1
        smaller = (points < x[:, None, :]).sum(axis=1)
        no_larger = (points <= x[:, None, :]).sum(axis=1)
        low, high = np.maximum(smaller - 1, 0), np.minimum(smaller, last)
        begin, end = np.take_along_axis(points, low, 0), np.take_along_axis(points, high, 0)
        share = np.clip((x - begin) / np.where(end > begin, end - begin, 1.0), 0.0, 1.0)
        between = normal[low] + share * (normal[high] - normal[low])
        # Where many windows share one value it becomes the middle of its quantiles.
        shared = 0.5 * (normal[high] + normal[np.maximum(no_larger - 1, 0)])
        return np.asarray(np.where(no_larger > smaller, shared, between))
