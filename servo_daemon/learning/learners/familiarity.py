"""How much a window is like those of the training: whether a learned model has a say about it at all.

Two tests, on all features, not only the screened ones, as in the monitoring of processes (Jackson & Mudholkar,
*Technometrics* 21, 1979): the kernel's mass among the training windows in the principal components, and the part of the
window that lies outside these (its squared prediction error: a combination of features that no motor of the training
showed). What is published is the smaller share of calibration motors that look less familiar by one of them. Faults
that look like another motor of the training are for `novelty`.
"""

from __future__ import annotations

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.decomposition import PCA

from servo_daemon.learning.learners.grnn import GRNN
from servo_daemon.samples import F64

#: A window is declined below this share: familiar ones then pass in 99.6 % by each test.
LEAST_FAMILIARITY = 0.004
_COMPONENTS = 20
_CENTRES = 600


class Familiarity(BaseEstimator):  # type: ignore[misc]  # scikit-learn is untyped
    """Scores how far windows lie from those of the training.

    Attributes:
        mass_, outside_: of the calibration windows, sorted, shape (n,).
    """

    def fit(self, z: F64, calibration: F64, seed: int = 0) -> Familiarity:
        """`Prepared.extended` of training and of calibration windows, shape (n, d)."""
        self._components = PCA(min(_COMPONENTS, z.shape[1], len(z) - 1), whiten=True, random_state=seed).fit(z)
        scores = self._components.transform(z)
        centres = min(_CENTRES, len(scores))
        # As wide as the usual distance to the neighbours that so many centres leave.
        width = 0.5 * np.sqrt(scores.shape[1])
        self._kernel = GRNN(bandwidth=width, n_prototypes=centres, random_state=seed).fit(scores, np.zeros(len(scores)))
        self.mass_, self.outside_ = (np.sort(t) for t in self._tests(calibration))
        return self

    def score(self, z: F64) -> F64:
        """Share of calibration windows that are less familiar, 0 .. 1, shape (n,)."""
        known = (self.mass_, self.outside_)
        below = [np.searchsorted(k, t) for k, t in zip(known, self._tests(z), strict=True)]
        return np.asarray(np.min(below, axis=0) / (len(self.mass_) + 1.0))

    def _tests(self, z: F64) -> tuple[F64, F64]:
        """Each the smaller the less familiar, shapes (n,)."""
        # What PCA's own `transform` and `inverse_transform` do, without their checks.
        p = self._components
        away = z - p.mean_
        along = away @ p.components_.T
        outside = np.square(away - along @ p.components_).sum(axis=1)
        return self._kernel.mass(along / np.sqrt(p.explained_variance_)), -outside
