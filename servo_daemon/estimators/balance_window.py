"""The balances over the last seconds: what they determine, and whether they close."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from servo_daemon.estimators.balances import (
    GramWindow,
    armature_slopes,
    information,
    mismatch_std,
    noise_gram,
    shaft_slopes,
)
from servo_daemon.estimators.excitation import WINDOW_S
from servo_daemon.samples import F64


class BalanceWindow:
    """Rows of both regressions as they come.

    Args:
        armature_columns, shaft_columns: what stands behind the regressors.
        judges_mismatch: False where the torque is itself only nearly known (no current is measured).
    """

    def __init__(
        self, armature_columns: tuple[str, ...], shaft_columns: tuple[str, ...], *, judges_mismatch: bool
    ) -> None:
        self._armature_columns, self._shaft_columns = armature_columns, shaft_columns
        self._judges_mismatch = judges_mismatch
        self._grams = {"armature": GramWindow(WINDOW_S), "shaft": GramWindow(WINDOW_S)}
        self._end_s = 0.0

    def clear(self) -> None:
        """What is in here is of another motor: a parameter has jumped, or all begins anew."""
        for window in self._grams.values():
            window.clear()

    def advance(self, time_s: float) -> None:
        """The present, s: rows older than `WINDOW_S` drop out, also where no new ones come."""
        self._end_s = time_s

    def add_armature(self, time_s: float, Phi: F64, y: F64, weight_squares: F64) -> None:
        """As for `GramWindow.add`."""
        self._grams["armature"].add(time_s, Phi, y, weight_squares)

    def add_shaft(self, time_s: float, Phi: F64, y: F64, weight_squares: F64) -> None:
        """As for `GramWindow.add`."""
        self._grams["shaft"].add(time_s, Phi, y, weight_squares)

    def determined(self, names: Sequence[str], value: Mapping[str, float], noise_var: Mapping[str, float]) -> F64:
        """Information on the coordinates of `names` that the last `WINDOW_S` hold if the balances are only nearly right
        (`balances.py`), shape (n, n); rows of parameters that are in no regression are zero.

        Args:
            value: of all parameters, natural units.
            noise_var: of the measured channels.
        """
        out = np.zeros((len(names), len(names)))
        total = self._grams["armature"].total(self._end_s)
        if total is not None:
            columns = (*self._armature_columns, "y")
            noise = noise_gram(columns, total[1], noise_var, None)
            out += information(total[0], noise, armature_slopes(columns, value), names, 1.0)
        total = self._grams["shaft"].total(self._end_s)
        if total is not None:
            per_current = self._grams["armature"].total(self._end_s) is not None
            columns = (*self._shaft_columns, "y")
            noise = noise_gram(columns, total[1], noise_var, "current_A" if per_current else None)
            slopes = shaft_slopes(columns, value, per_current)
            out += information(total[0], noise, slopes, names, value["K"] if per_current else 1.0)
        return out

    def mismatch(
        self, value: Mapping[str, float], noise_var: Mapping[str, float], sample_period_s: float
    ) -> dict[str, float]:
        """1 σ of the coordinates by which they may be off because the balances do not close over the last `WINDOW_S`.

        Args:
            value: of all parameters, natural units.
            noise_var: of the measured channels, what the current does between two samples included.
            sample_period_s: a winding much faster than this cannot be judged by integrals over samples.
        """
        out: dict[str, float] = {}
        if not self._judges_mismatch:
            return out
        total = self._grams["armature"].total(self._end_s)
        if total is not None and value["L"] > 2.0 * sample_period_s * value["R"]:
            columns = (*self._armature_columns, "y")
            slopes = armature_slopes(columns, value)
            noise = np.diag(noise_gram(columns, total[1], noise_var, None))
            out |= mismatch_std(total[0], _explained(noise, slopes, 1.0), slopes)
        total = self._grams["shaft"].total(self._end_s)
        if total is not None:
            per_current = self._grams["armature"].total(self._end_s) is not None
            columns = (*self._shaft_columns, "y")
            slopes = shaft_slopes(columns, value, per_current)
            noise = np.diag(noise_gram(columns, total[1], noise_var, "current_A" if per_current else None))
            size = value["K"] if per_current else 1.0
            found = mismatch_std(total[0], _explained(noise, slopes, size), {n: s / size for n, s in slopes.items()})
            out |= {name: std for name, std in found.items() if name not in out}
        return out


def _explained(noise: F64, slopes: Mapping[str, F64], size_per_y: float) -> float:
    """The sum of squares that noise, shape (m + 1,), leaves of a fit with these slopes."""
    coefficients = np.zeros(len(noise))
    for slope in slopes.values():
        coefficients = np.maximum(coefficients, np.abs(slope) / size_per_y)
    coefficients[-1] = 1.0
    return float(np.square(coefficients) @ noise)
