"""The balances over the last seconds: what they determine, whether they close, what they say of the filter."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.regression import residual_analysis
from servo_daemon.regression.balances import (
    NOISE_KNOWN,
    GramWindow,
    Sums,
    armature_slopes,
    expected_square,
    information,
    noise_gram,
    noise_squares,
    shaft_slopes,
)
from servo_daemon.regression.columns.terms import armature_coefficient, coefficient, is_share
from servo_daemon.regression.hidden_friction import HiddenFriction
from servo_daemon.regression.residual_analysis import MeanError, Residuals
from servo_daemon.regression.rls_fit import CHANCE_STDS, OVERLAP
from servo_daemon.regression.sampling import WINDOW_S, Sampling, between_samples, blind_std, of_standing_counts
from servo_daemon.samples import F64

#: Share of the window's rows whose residuals with the filter's values must be known (chosen; half and twice move no
#: tracking figure).
_COVERED = 0.8
#: The first rows, s, are less exact: what the current does between two samples was not known yet (chosen; free within
#: half and twice).
_RECENT_S = 1.5
#: Rows for each column from which on what a fit leaves says how large the noise is (chosen; free within half and
#: twice).
_ROWS_PER_COLUMN = 6
#: The margin for the angle's noise (`balances`) allows for so many samples on one count (chosen; half and twice move no
#: tracking figure).
_COUNTS_IN_MARGIN = 4.0
#: What the current does between samples, as a share of what a balance leaves: beyond, no noise can be told from it
#: (chosen; half and twice move no tracking figure).
_HIDES = 0.5


@dataclass(frozen=True, slots=True)
class _Linear:
    """A balance at the filter's values.

    Attributes:
        value, per_current: at which.
        theta: the coefficients of Φ's columns, shape (n,).
        slopes: d residual / d coordinate, as weights on the columns.
    """

    value: Mapping[str, float]
    per_current: bool
    theta: F64
    slopes: dict[str, F64]


class BalanceWindow:
    """Rows of both regressions as they come.

    Args:
        armature_columns, shaft_columns: what stands behind the regressors.
        judges_mismatch: False where the torque is itself only nearly known (no current is measured).

    Attributes:
        hidden_friction: what the shaft's rows say of dry friction that the model lacks.
    """

    def __init__(
        self, armature_columns: tuple[str, ...], shaft_columns: tuple[str, ...], *, judges_mismatch: bool
    ) -> None:
        self._columns = {"armature": (*armature_columns, "y"), "shaft": (*shaft_columns, "y")}
        self.judges_mismatch = judges_mismatch
        self._grams = {which: GramWindow(WINDOW_S) for which in self._columns}
        self.hidden_friction = HiddenFriction(shaft_columns)
        self._new: list[tuple[str, float, Sums]] = []
        self._residuals: dict[str, deque[tuple[float, Residuals]]] = {which: deque() for which in self._columns}
        self._last: dict[str, _Linear] = {}
        self._end_s = 0.0

    def clear(self) -> None:
        """What is in here is of another motor: a parameter has jumped, or all begins anew."""
        for which, window in self._grams.items():
            window.clear()
            self._residuals[which].clear()
        self.hidden_friction.clear()
        self._new = []

    def advance(self, time_s: float) -> None:
        """The present, s: rows older than `WINDOW_S` drop out, also where no new ones come."""
        self._end_s = time_s
        for parts in self._residuals.values():
            while parts and time_s - parts[0][0] > WINDOW_S:
                parts.popleft()

    def add(self, which: str, time_s: float, part: Sums) -> None:
        """Rows that end at about `time_s`.

        Args:
            which: "armature" or "shaft".
        """
        self._grams[which].add(time_s, part)
        self._new.append((which, time_s, part))

    @property
    def _per_current(self) -> bool:
        """The shaft's rows are those of ∫φ i, with K from the armature."""
        return self._grams["armature"].total(self._end_s) is not None

    def determined(self, names: Sequence[str], value: Mapping[str, float], sampling: Sampling) -> F64:
        """Information on the coordinates of `names` that the last `WINDOW_S` hold if the balances are only nearly right
        (`balances.py`), shape (n, n); rows of parameters that are in no regression are zero.

        Args:
            value: of all parameters, natural units.
        """
        out = np.zeros((len(names), len(names)))
        for which, columns in self._columns.items():
            total = self._grams[which].total(self._end_s)
            if total is None or (which == "shaft" and sampling.stands):
                continue
            noise_var = of_standing_counts(sampling, which, _COUNTS_IN_MARGIN)
            noise = noise_gram(columns, total.weight_squares, noise_var, self.y_channel(which))
            out += information(total.gram, noise, self._linear(which, value).slopes, names, self._size(which, value))
        return out

    def mismatch(self, value: Mapping[str, float], sampling: Sampling) -> dict[str, float]:
        """1 σ of the coordinates by which they may be off because the balances do not close over the last `WINDOW_S`.

        Args:
            value: of all parameters, natural units.
        """
        out: dict[str, float] = {}
        if not self.judges_mismatch:
            return out
        for which in self._columns:
            total = self._grams[which].total(self._end_s)
            if total is None:
                continue
            size = self._size(which, value)
            slopes = {name: slope / size for name, slope in self._linear(which, value).slopes.items()}
            noise = self._noise(which, total, value, sampling) * self._by_chance(which, total)
            found = residual_analysis.mismatch_std(total.gram, noise, slopes, self._followed(which, total))
            out |= {name: std for name, std in found.items() if name not in out}
        return out

    def _followed(self, which: str, total: Sums) -> float:
        """What the filter's values of the time leave of the window's rows; infinite where they are known of too few
        rows."""
        parts = [part for _, part in self._residuals[which]]
        rows = sum(part.sums.rows for part in parts)
        if rows < _COVERED * total.rows:
            return np.inf
        return sum(part.square for part in parts) * total.rows / rows

    def unexplained_torque(self, value: Mapping[str, float], sampling: Sampling, torque_Nm: float) -> float:
        """Intensity, (N·m)²·s, of a white torque that would leave of the shaft's balance what its best fit does, and no
        chance would.

        Args:
            torque_Nm: typical motor torque, with which the balance need not close any better at a rest.
        """
        total, columns = self._grams["shaft"].total(self._end_s), self._columns["shaft"]
        if total is None or not self.judges_mismatch:
            return 0.0
        noise = self._noise("shaft", total, value, replace(sampling, noise_var=of_standing_counts(sampling, "shaft")))
        noise *= self._by_chance("shaft", total)
        ones, usual_current = _constant(columns), torque_Nm / self._size("shaft", value)
        usual = float(ones @ total.gram @ ones) * usual_current**2
        left = residual_analysis.structure(total.gram, noise, usual)
        # White noise of intensity S adds S ∫φ² to the square of ∫φ τ; Σ (φ h)² = h ∫φ².
        of_one = float(total.weight_squares[0]) / sampling.period_s
        return left * self._size("shaft", value) ** 2 / max(of_one, 1e-300)

    def input_noise(self, value: Mapping[str, float], sampling: Sampling) -> float | None:
        """Variance of what the winding gets beside the recorded voltage, V²: as white noise of each held piece, after
        what the armature's balance leaves that is not noise of the other channels. None without that balance."""
        total = self._grams["armature"].total(self._end_s)
        if total is None:
            return None
        noise = self._noise("armature", total, value, sampling) / NOISE_KNOWN
        left = residual_analysis.residual_square(total.gram) - noise
        return max(left, 0.0) / max(float(total.weight_squares[0]), 1e-300)

    def current_noise(self, sampling: Sampling) -> float | None:
        """Variance of the current's sensor, A²: what the best fit of the shaft's balance leaves, as far as what the
        current does between samples does not explain it. A current that really flows moves the shaft, noise of its
        sensor does not; anything that the model lacks makes this too large. None without that balance, where there are
        too few rows, and where what flows between samples hides the sensor's noise.
        """
        total, columns = self._grams["shaft"].since(self._end_s - _RECENT_S), self._columns["shaft"]
        if total is None or not self._per_current or total.rows < _ROWS_PER_COLUMN * len(columns):
            return None
        free = 1.0 - (len(columns) - 1) / total.rows
        found = residual_analysis.residual_square(total.gram) / free / max(float(total.weight_squares[0]), 1e-300)
        between = between_samples(sampling, "shaft")
        return None if between > _HIDES * found else found

    def take_residuals(self, value: Mapping[str, float], noise_var: Mapping[str, float]) -> None:
        """Residuals of the rows that came since the last call, with the filter's values."""
        for which, time_s, part in self._new:
            columns = self._columns[which]
            noise = noise_squares(columns[:-1], part.weight_squares, noise_var)
            theta = self._linear(which, value).theta
            self._residuals[which].append((time_s, Residuals.of(part, theta, noise)))
        self._new = []

    def pass_over(self) -> None:
        """No residuals are taken of rows that came since: a change is being examined."""
        self._new = []

    def forget_values(self) -> None:
        """The residuals so far are of values that the filter no longer has of that time."""
        for parts in self._residuals.values():
            parts.clear()

    def mean_errors(self, value: Mapping[str, float], period_s: float) -> dict[str, tuple[float, float]]:
        """(error, variance) of the logarithms that the filter has, by the balances over the last `WINDOW_S`.

        Args:
            value: of all parameters, natural units.
            period_s: usual distance of two samples.
        """
        out: dict[str, tuple[float, float]] = {}
        if not self.judges_mismatch:
            return out
        K = (0.0, 0.0)
        for which, columns in self._columns.items():
            found: MeanError | None = residual_analysis.mean_error([part for _, part in self._residuals[which]])
            if found is None:
                if which == "armature" and self._per_current:
                    return {}  # without K the shaft's coefficients are quotients only
                continue
            theta = self._linear(which, value).theta.tolist()
            for k, name in enumerate(columns[:-1]):
                if name in ("R", "L", "K", "J", "B", "Tc"):
                    scale, blind = 1.0 / theta[k], blind_std(name, value, period_s)
                    own = (scale * float(found.error[k]), scale**2 * float(found.covariance[k, k]) + blind**2)
                    out[name] = own if which == "armature" else (own[0] + K[0], own[1] + K[1])
            K = out.get("K", K)
        return out

    def _by_chance(self, which: str, total: Sums) -> float:
        """By how much larger than expected a sum of squares is that is so by chance."""
        free = max(total.rows - len(self._columns[which]), 1)
        return 1.0 + CHANCE_STDS * math.sqrt(2.0 * OVERLAP / free)

    def y_channel(self, which: str) -> str | None:
        """The noisy channel that a balance's y is ∫φ of, if it is one."""
        return "current_A" if which == "shaft" and self._per_current else None

    def _size(self, which: str, value: Mapping[str, float]) -> float:
        """The balance's size per unit of its last column."""
        return value["K"] if which == "shaft" and self._per_current else 1.0

    def _linear(self, which: str, value: Mapping[str, float]) -> _Linear:
        """Looked up once for the same values: one judgement asks several times."""
        per_current, last = self._per_current, self._last.get(which)
        if last is None or last.value is not value or last.per_current != per_current:
            columns = self._columns[which]
            theta = _coefficients(columns[:-1], value, self._size(which, value))
            slopes = (
                armature_slopes(columns, value) if which == "armature" else shaft_slopes(columns, value, per_current)
            )
            last = self._last[which] = _Linear(value, per_current, theta, slopes)
        return last

    def _noise(self, which: str, total: Sums, value: Mapping[str, float], sampling: Sampling) -> float:
        """The sum of squares that noise and sampling leave of the best fit."""
        theta = self._linear(which, value).theta
        return expected_square(which, self._columns[which], total, theta, sampling, self.y_channel(which))


def _coefficients(columns: Sequence[str], value: Mapping[str, float], size: float) -> F64:
    """Of Φ's columns with these values, shape (n,).

    Args:
        size: of the balance per unit of y.
    """
    if "R" in columns:
        return np.array([armature_coefficient(c, value)[0] for c in columns])
    return np.array([_of_shaft(c, value, size) for c in columns])


def _of_shaft(column: str, value: Mapping[str, float], size: float) -> float:
    found = coefficient(column, value)[0]
    if is_share(column):
        return found
    return found / size + (value.get("i0", 0.0) if column == "one" else 0.0)


def _constant(columns: Sequence[str]) -> F64:
    """The regressor of a constant torque as weights on the shaft's columns: friction by direction has two levels in the
    place of the constant's own column, and the one less the other is a constant while the shaft turns."""
    weights = {"one": 1.0} if "one" in columns else {"Tc": 1.0, "Tc_neg": -1.0}
    return np.array([weights.get(name, 0.0) for name in columns])
