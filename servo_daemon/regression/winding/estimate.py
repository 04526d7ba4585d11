"""R, L and K from the winding's rows, with what noise in the regressors and coarse sampling may have done to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.numerics import inverse_of_information
from servo_daemon.parameters import WINDING_NAMES
from servo_daemon.regression.linear_regression import long_run
from servo_daemon.regression.sampling import settles_between
from servo_daemon.regression.winding.rows import RESOLVED, Rows, added_up, unresolved
from servo_daemon.samples import F64
from servo_daemon.signal_meaning import SignalMeaning

NAMES = WINDING_NAMES
#: The column of the current's rate.
_RATE = NAMES.index("L")
#: Windows that are tried, s; beyond, what the shaft does between their ends is averaged away.
WINDOWS_S = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
#: Fewest rows for each column (chosen; half and twice move no tracking figure).
_ROWS_PER_COLUMN = 8
#: A bound that holds in the worst case, as 1 σ of what is equally likely anywhere below it.
_UNIFORM = 1.0 / np.sqrt(3.0)
#: Of two derivatives the finer one is exact to h⁴: at the fastest motion that five points still follow (a tenth of the
#: sampling rate) its error is a twelfth of the coarser one's ((ωh)⁴/30 against (ωh)²/6 at ωh = 0.63: 1/13). Where
#: samples do not follow the current it is no better than that.
_FINER = 1.0 / 12.0
#: A parameter is determined below this share of itself, 1 σ; stricter than `regression.estimate.KNOWS`, for here no
#: filter stands beside it (chosen; half and twice move no tracking figure).
_KNOWN = 0.2
#: What else may be in the balance: a drive's dead time is a voltage against the current's direction, a sensor's zero a
#: constant. Either biases R and K where the model has none; it is seen beyond so many standard deviations.
_EXTRAS = {"Vb": "a voltage against the current's direction", "v0": "a constant voltage"}
_SEEN = 3.0
#: Samples within L/R that follow the current (chosen; half and twice move no tracking figure).
_FOLLOWED = 4.0


@dataclass(frozen=True, slots=True)
class WindingEstimate:
    """R, L and K by the voltage's balance.

    Attributes:
        names: of R, L and K (and what was added) those that are determined.
        value: shape (n,), natural units.
        covariance: shape (n, n).
        window_s: over which rows were added up.
        extra: what else the balance holds that was not asked for, in words; None: nothing that shows.
    """

    names: tuple[str, ...]
    value: F64
    covariance: F64
    window_s: float
    extra: str | None = None

    @property
    def std(self) -> F64:
        return np.sqrt(np.diag(self.covariance))

    def of(self, name: str) -> tuple[float, float] | None:
        """Value and 1 σ; None where it is not determined."""
        if name not in self.names:
            return None
        k = self.names.index(name)
        return float(self.value[k]), float(self.std[k])

    @property
    def badness(self) -> float:
        """Sum of squares of the relative errors of R and K; one that is not determined counts as all of itself."""
        pairs = [self.of(name) for name in ("R", "K")]
        return sum(1.0 if p is None else (p[1] / p[0]) ** 2 for p in pairs)


def estimate_winding(
    recordings: Sequence[Rows],
    held: Mapping[str, float] | None = None,
    added: Sequence[str] = (),
    windows_s: Sequence[float] = WINDOWS_S,
) -> WindingEstimate | None:
    """The estimate whose standard deviations are smallest over the lengths of windows; None where there are too few
    rows or nothing is determined.

    Args:
        recordings: rows of each, of one motor.
        held: parameters that are given.
        added: further columns that the model has: "Vb" (V sgn i), "v0" (a constant).
        windows_s: lengths that are tried.
    """
    found = [_at_length(recordings, window_s, dict(held or {}), tuple(added)) for window_s in windows_s]
    good = [f for f in found if f is not None]
    return min(good, key=lambda f: f.badness) if good else None


def as_meant(found: WindingEstimate, meaning: SignalMeaning, period_s: float) -> WindingEstimate:
    """The estimate with what no row can show of signals of this meaning: a factor of the whole voltage, which is one of
    R, L and K, and an inductance between instants.

    Args:
        period_s: usual distance of two samples.
    """
    if meaning.voltage == "instant":
        found = without_hidden_inductance(found, period_s)
    scaled = found.value * [name in NAMES for name in found.names]
    return replace(found, covariance=found.covariance + meaning.voltage_scale_std**2 * np.outer(scaled, scaled))


def without_hidden_inductance(found: WindingEstimate, period_s: float) -> WindingEstimate:
    """The same without L where instants are further apart than a quarter of what the current of such a winding takes:
    what the voltage did for it meanwhile no sample shows.

    Args:
        period_s: usual distance of two samples.
    """
    R, L = found.of("R"), found.of("L")
    if L is None or (R is not None and not settles_between(R[0], L[0], _FOLLOWED * period_s)):
        return found
    keep = [k for k, name in enumerate(found.names) if name != "L"]
    names = tuple(found.names[k] for k in keep)
    return replace(found, names=names, value=found.value[keep], covariance=found.covariance[np.ix_(keep, keep)])


def _at_length(
    recordings: Sequence[Rows], window_s: float, held: Mapping[str, float], added: tuple[str, ...]
) -> WindingEstimate | None:
    lengths = [max(1, round(window_s / r.step_s)) for r in recordings]
    if window_s > 0.0 and max(lengths) == 1:
        return None  # the same as single rows
    sums = [added_up(r, length) for r, length in zip(recordings, lengths, strict=True)]
    names = (*NAMES, *added)
    X, other = (_with_added(np.concatenate(c), added) for c in ([s.X for s in sums], [s.other for s in sums]))
    y, y_rate, bend = (np.concatenate([getattr(s, name) for s in sums]) for name in ("y", "y_rate", "bend"))
    if len(y) < _ROWS_PER_COLUMN * len(names):
        return None
    current = X[:, 0]
    y = y - X @ np.array([held.get(n, 0.0) for n in names])
    free = [k for k, n in enumerate(names) if n not in held and X[:, k].any()]
    if not free:
        return None
    fit = _Fit.of(X[:, free], y)
    finer = min(1.0, _FINER + (unresolved(recordings) / RESOLVED) ** 2)
    covariance = fit.covariance + fit.pulled() + fit.moved_by(finer * (other - X)[:, free] @ fit.value)
    covariance += fit.moved_by(_UNIFORM * max(r.skew_s for r in recordings) * y_rate)
    if _RATE in free:
        covariance += fit.moved_by(_UNIFORM * fit.value[free.index(_RATE)] * bend)
    extra = None
    for name, words in _EXTRAS.items():
        if name not in added and (change := fit.beside(_column(name, current), y)) is not None:
            covariance += np.outer(change, change)
            extra = words
    known = [k for k, j in enumerate(free) if _is_known(names[j], fit.value[k], covariance[k, k])]
    if not known:
        return None
    found = tuple(names[free[k]] for k in known)
    return WindingEstimate(found, fit.value[known], covariance[np.ix_(known, known)], window_s, extra)


def _is_known(name: str, value: float, variance: float) -> bool:
    return name not in NAMES or (value > 0.0 and bool(np.sqrt(variance) < _KNOWN * value))


def _column(name: str, current: F64) -> F64:
    return np.sign(current) if name == "Vb" else np.ones(len(current))


def _with_added(X: F64, added: Sequence[str]) -> F64:
    """The columns with those of the direction of the current and of a constant."""
    return np.column_stack([X, *(_column(name, X[:, 0]) for name in added)])


@dataclass(frozen=True, slots=True)
class _Fit:
    """Least squares y = X β; `inverse` is (XᵀX)⁻¹."""

    X: F64
    value: F64
    residual: F64
    inverse: F64
    covariance: F64

    @classmethod
    def of(cls, X: F64, y: F64) -> _Fit:
        scale = np.sqrt(np.mean(X**2, axis=0))
        scale[scale == 0.0] = 1.0
        inverse = inverse_of_information(X.T @ X)
        value = inverse @ (X.T @ y)
        residual = y - X @ value
        scores = X / scale * residual[:, None]
        covariance = inverse @ (long_run(scores) * np.outer(scale, scale)) @ inverse
        return cls(X, value, residual, inverse, covariance)

    def moved_by(self, error: F64) -> F64:
        """Covariance of what such an error of y, shape (w,), of either sign would do."""
        moved = self.inverse @ (self.X.T @ error)
        return np.outer(moved, moved)

    def pulled(self) -> F64:
        """If all that is left were noise of one regressor: it pulls that one's coefficient towards zero, and the others
        with it."""
        power, out = float(self.residual @ self.residual), np.zeros_like(self.inverse)
        for k in np.flatnonzero(self.value):
            pull = _UNIFORM * self.inverse[:, k] * power / self.value[k]
            out += np.outer(pull, pull)
        return out

    def beside(self, column: F64, y: F64) -> F64 | None:
        """By how much one more column changes the values, shape (n,); None where it is not seen."""
        wider = _Fit.of(np.column_stack([self.X, column]), y)
        if wider.value[-1] ** 2 < _SEEN**2 * wider.covariance[-1, -1]:
            return None
        return np.asarray(wider.value[:-1] - self.value)
