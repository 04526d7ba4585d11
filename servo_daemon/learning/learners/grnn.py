"""The generalised regression neural network (D. F. Specht, *IEEE Trans. Neural Networks* 2, 1991), for scikit-learn.

    ŷ(x) = Σ_j A_j exp(−½ D_j²) / Σ_j n_j exp(−½ D_j²),   D_j² = Σ_k (x_k − c_jk)²/h_k²

With every training window its own centre (n_j = 1, A_j = y_j) this is his equation (6), the Nadaraya–Watson estimate;
with fewer centres it is his equation (14): c_j the mean of n_j windows, A_j the sum of their outputs. Ours are: a
bandwidth for each feature, fitted by the leave-one-group-out error; k-means for the centres; the variance of the
outputs under the same kernel; and the kernel's mass, which says how much like anything it has seen a window is.
"""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils import check_random_state
from sklearn.utils._param_validation import Interval
from sklearn.utils.validation import check_is_fitted, validate_data

from servo_daemon.learning.learners.loo import fit_bandwidths, kernel, square_distances
from servo_daemon.samples import F64

#: Windows are worked off so many at a time: bounds the matrix of distances.
_ROWS = 512


class GRNN(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn is untyped
    """Kernel regression over prototypes, one width a feature.

    Args:
        bandwidth: h in standard deviations of each feature, one number or shape (d,); None: fitted.
        n_prototypes: most centres; None: every window.
        max_windows: the bandwidths are fitted on at most so many windows (time and memory grow with the square).
        max_iter: of that fit.
        random_state: of the choice of those windows, and of k-means.

    Attributes:
        bandwidth_: shape (d,), in standard deviations of the features.
        n_iter_: iterations of their fit.
        centers_: shape (c, d), in units of the bandwidths.
        size_: shape (c,), their squares' sums: half of what a distance to them takes.
        count_: shape (c,), windows behind each centre.
        mean_, square_: shape (c, m): means of their outputs and of the squares of these.
    """

    _parameter_constraints: dict[str, list[Any]] = {  # noqa: RUF012  (scikit-learn's own form)
        "bandwidth": [Interval(Real, 0, None, closed="neither"), "array-like", None],
        "n_prototypes": [Interval(Integral, 1, None, closed="left"), None],
        "max_windows": [Interval(Integral, 2, None, closed="left")],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "random_state": ["random_state"],
    }

    def __init__(
        self,
        bandwidth: float | F64 | None = None,
        n_prototypes: int | None = None,
        max_windows: int = 2000,
        max_iter: int = 60,
        random_state: int | None = None,
    ) -> None:
        self.bandwidth = bandwidth
        self.n_prototypes = n_prototypes
        self.max_windows = max_windows
        self.max_iter = max_iter
        self.random_state = random_state

    def fit(self, X: Any, y: Any, groups: Any = None) -> GRNN:
        """Bandwidths and centres.

        Args:
            X: features, shape (n, d).
            y: outputs, shape (n,) or (n, m).
            groups: shape (n,): windows of one motor share a label, and are left out together; None: each its own.

        Raises:
            ValueError: shapes that do not fit, values that are not finite.
        """
        self._validate_params()
        X, y = validate_data(self, X, y, dtype=np.float64, multi_output=True, y_numeric=True)
        targets = np.asarray(y, dtype=np.float64).reshape(len(X), -1)
        self._flat = np.ndim(y) == 1
        label = np.arange(len(X)) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]
        if label.shape != (len(X),):
            raise ValueError(f"groups has shape {label.shape}, X has {len(X)} rows")
        random = check_random_state(self.random_state)
        self.n_iter_ = 1
        self._origin, self._unit = X.mean(axis=0), _spread(X)
        self.bandwidth_ = self._bandwidths((X - self._origin) / self._unit, targets, label, random)
        self._place(self._scaled(X), targets, random)
        self.size_ = np.square(self.centers_).sum(axis=1)
        return self

    def _bandwidths(self, X: F64, y: F64, groups: NDArray[np.int64], random: np.random.RandomState) -> F64:
        d = X.shape[1]
        if self.bandwidth is not None:
            given = np.broadcast_to(np.asarray(self.bandwidth, dtype=np.float64), (d,)).copy()
            if not (np.isfinite(given).all() and (given > 0).all()):
                raise ValueError("bandwidth must be greater than zero")
            return given
        if len(X) > self.max_windows:
            chosen = random.permutation(len(X))[: self.max_windows]
            X, y, groups = X[chosen], y[chosen], groups[chosen]
        if len(np.unique(groups)) < 2:  # nothing to leave out
            return np.ones(d)
        found, self.n_iter_ = fit_bandwidths(X, (y - y.mean(axis=0)) / _spread(y), groups, self.max_iter)
        return found

    def _place(self, Z: F64, y: F64, random: np.random.RandomState) -> None:
        """Centres in the kernel's own metric."""
        if self.n_prototypes is None or self.n_prototypes >= len(Z):
            self.centers_, self.count_ = Z, np.ones(len(Z))
            self.mean_, self.square_ = y, np.square(y)
            return
        from sklearn.cluster import KMeans

        most = int(self.n_prototypes)
        found = KMeans(most, n_init=1, max_iter=25, random_state=random).fit(Z)
        own = found.labels_
        count = np.bincount(own, minlength=most).astype(np.float64)
        kept = count > 0

        def means(values: F64) -> F64:
            sums = np.zeros((most, values.shape[1]))
            np.add.at(sums, own, values)
            return np.asarray(sums[kept] / count[kept, None])

        self.centers_, self.count_ = means(Z), count[kept]
        self.mean_, self.square_ = means(y), means(np.square(y))

    def _scaled(self, X: F64) -> F64:
        return np.asarray((X - self._origin) / (self._unit * self.bandwidth_))

    @overload
    def predict(self, X: Any, return_std: Literal[False] = False) -> F64: ...
    @overload
    def predict(self, X: Any, return_std: Literal[True]) -> tuple[F64, F64]: ...
    def predict(self, X: Any, return_std: bool = False) -> F64 | tuple[F64, F64]:
        """ŷ, shape (n,) or (n, m), as y was; with `return_std` also the outputs' standard deviation under the kernel.

        Raises:
            ValueError: X does not have the features of the training.
        """
        check_is_fitted(self)
        value, std = self.answer(validate_data(self, X, dtype=np.float64, reset=False))
        if self._flat:
            value, std = value[:, 0], std[:, 0]
        return (value, std) if return_std else value

    def answer(self, X: F64) -> tuple[F64, F64]:
        """ŷ and its standard deviation, both of shape (n, m), for features known to be finite and those of the
        training: scikit-learn's checks of one window take as long as the answer."""
        Z = self._scaled(X)
        value, std = np.empty((len(Z), self.mean_.shape[1])), np.empty((len(Z), self.mean_.shape[1]))
        for rows in _pieces(len(Z)):
            w = kernel(square_distances(Z[rows], self.centers_, self.size_)) * self.count_
            w /= w.sum(axis=1, keepdims=True)
            value[rows] = w @ self.mean_
            std[rows] = np.sqrt(np.maximum(w @ self.square_ - np.square(value[rows]), 0.0))
        return value, std

    def familiarity(self, X: Any) -> F64:
        """log Σ_j n_j exp(−½ D_j²), shape (n,): of how many training windows this one is a neighbour, as a logarithm.
        Far below 0 nothing like it has been seen.

        Raises:
            ValueError: X does not have the features of the training.
        """
        check_is_fitted(self)
        return self.mass(validate_data(self, X, dtype=np.float64, reset=False))

    def mass(self, X: F64) -> F64:
        """The same for features known to be finite and those of the training."""
        Z = self._scaled(X)
        out = np.empty(len(Z))
        for rows in _pieces(len(Z)):
            d2 = square_distances(Z[rows], self.centers_, self.size_)
            nearest = d2.min(axis=1)
            out[rows] = np.log(kernel(d2) @ self.count_) - 0.5 * nearest
        return out


def _spread(values: F64) -> F64:
    """Standard deviations of columns; 1 for one that does not vary."""
    std = values.std(axis=0)
    return np.where(std > 1e-12 * (np.abs(values).max(axis=0) + 1e-300), std, 1.0)


def _pieces(n: int) -> list[slice]:
    return [slice(k, min(k + _ROWS, n)) for k in range(0, n, _ROWS)]
