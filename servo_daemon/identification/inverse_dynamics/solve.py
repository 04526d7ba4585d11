"""Solving the shaft's balance: what is given goes to the known side, and coefficients become parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.identification.inverse_dynamics.armature import ArmatureFit
from servo_daemon.regression.linear_regression import LinearFit, fit_linear
from servo_daemon.samples import F64

#: (phi, Tg) → names, columns (w, m), time (w,); see `idim_shaft.rows`.
MakeRows = Callable[[tuple[float | None, float | None]], tuple[list[str], F64, F64]]
_PHASE_ROUNDS = 20


@dataclass(frozen=True, slots=True)
class ShaftFit:
    """Parameters of the shaft.

    Attributes:
        names: length n. value: shape (n,). covariances: shape (3, n, n), as in `LinearFit`.
        by_armature: d value / d (armature's values), shape (n, k): K and i0 come from there.
        ratios: whether names are ratios to K ("J/K").
        series: time, measured and predicted effort of the rows, shapes (w,).
        null_directions: see `LinearFit`.
        notes: for the user.
    """

    names: tuple[str, ...]
    value: F64
    covariances: F64
    by_armature: F64
    ratios: bool
    series: tuple[F64, F64, F64]
    null_directions: tuple[Mapping[str, float], ...]
    notes: list[str] = field(default_factory=list)

    def changed(self, names: tuple[str, ...], value: F64, by: F64) -> ShaftFit:
        """Other parameters, `by` their derivatives by these."""
        return replace(
            self,
            names=names,
            value=value,
            covariances=by @ self.covariances @ by.T,
            by_armature=by @ self.by_armature,
        )


@dataclass(frozen=True, slots=True)
class _Problem:
    make_rows: MakeRows
    given: Mapping[str, float]
    armature: ArmatureFit | None
    factor: float | None  # torque per unit of effort; None: unknown

    def solve(self, gravity: tuple[float | None, float | None]) -> tuple[ShaftFit, LinearFit]:
        """With gravity linearised at `gravity`; coefficients still as the columns have them."""
        names, table, time = self.make_rows(gravity)
        columns = dict(zip(names, table.T, strict=True))
        effort, one = columns.pop("effort"), columns.pop("one")
        known = columns.pop("gravity", np.zeros_like(effort))
        for name in [n for n in columns if n in self.given]:
            column = columns.pop(name)
            if name != "phi_g":
                known = known + self.given[name] * column
        effort = effort - self._offset() * one
        if self.factor is None:
            return self._unknown_factor(columns, effort, known, time)
        X = np.column_stack(list(columns.values()))
        fit = fit_linear(tuple(columns), X, self.factor * effort - known)
        measured = self.factor * effort
        k = 0 if self.armature is None else len(self.armature.names)
        by_armature = np.zeros((len(fit.value), k))
        for at, name in enumerate(self.armature.names if self.armature is not None else ()):
            if name == "K" and "K" not in self.given:
                by_armature[:, at] = fit_linear(tuple(columns), X, effort).value  # K multiplies the effort
            elif name == "i0":
                by_armature[:, at] = -self.factor * fit_linear(tuple(columns), X, one).value
        series = (time, measured, measured - fit.residual)
        shaft = ShaftFit(fit.names, fit.value, fit.covariances, by_armature, False, series, fit.null_directions)
        return shaft, fit

    def _offset(self) -> float:
        if "i0" in self.given:
            return self.given["i0"]
        if self.armature is None or "i0" not in self.armature.names:
            return 0.0
        return float(self.armature.value[self.armature.names.index("i0")])

    def _unknown_factor(
        self, columns: Mapping[str, F64], effort: F64, known: F64, time: F64
    ) -> tuple[ShaftFit, LinearFit]:
        """i = known/K + Σ (parameter/K) column: with something known K is determined, without it only ratios are."""
        anything = bool(np.any(known))
        table = ({"known": known} if anything else {}) | dict(columns)
        fit = fit_linear(tuple(table), np.column_stack(list(table.values())), effort)
        determined = "known" in fit.names
        series = (time, effort, effort - fit.residual)
        empty = np.zeros((len(fit.value), 0 if self.armature is None else len(self.armature.names)))
        raw = ShaftFit(
            fit.names,
            fit.value,
            fit.covariances,
            empty,
            not determined,
            series,
            fit.null_directions,
        )
        if not determined:
            note = "only ratios to K: give K (--fix K=…) or a known load for the parameters themselves"
            return replace(raw, notes=[note]), fit
        K = 1.0 / float(fit.value[0])
        if K <= 0.0:
            raise BadInputError(f"the known load gives K = {K:.4g}: is the sign of the current or of the load right?")
        value, by = fit.value * K, np.eye(len(fit.value)) * K
        value[0], by[0, 0] = K, -(K**2)
        by[1:, 0] = -fit.value[1:] * K**2
        return raw.changed(("K", *fit.names[1:]), value, by), fit


def solve_shaft(
    make_rows: MakeRows, given: Mapping[str, float], armature: ArmatureFit | None, is_torque: bool
) -> ShaftFit:
    """Least squares for the shaft.

    Args:
        make_rows: filtered columns, see `idim_shaft.rows`.
        given: fixed parameters.
        armature: its fit, if voltage and current are there: K comes from it unless given.
        is_torque: the effort is a torque and no current.

    Raises:
        BadInputError: too few rows, or signs that no motor has.
    """
    factor: float | None = 1.0 if is_torque else given.get("K")
    if factor is None and armature is not None:
        factor = armature.get("K", given)
        if factor is None and not armature.fit.is_unclear("K"):
            K = float(armature.value[armature.names.index("K")])
            raise BadInputError(
                f"voltage and speed of this capture give K = {K:.4g}: is the sign of position or voltage right?"
            )
    problem = _Problem(make_rows, given, armature, factor)
    phi, Tg = given.get("phi_g"), given.get("Tg")
    shaft, _ = problem.solve((phi, Tg if phi is not None else None))
    if "Tg sin" in shaft.names and "Tg cos" in shaft.names:
        shaft = _amplitude_and_phase(shaft)
        if Tg is not None:
            shaft = _iterated_phase(problem, float(shaft.value[shaft.names.index("phi_g")]), Tg)
    if shaft.ratios:
        shaft = replace(shaft, names=tuple(n if n == "phi_g" else f"{n}/K" for n in shaft.names))
    return shaft


def _amplitude_and_phase(s: ShaftFit) -> ShaftFit:
    """Tg sin(θ + φ) = (Tg cos φ) sin θ + (Tg sin φ) cos θ."""
    a, b = s.names.index("Tg sin"), s.names.index("Tg cos")
    c, d = float(s.value[a]), float(s.value[b])
    size = max(float(np.hypot(c, d)), 1e-300)
    by, value = np.eye(len(s.value)), s.value.copy()
    by[a, [a, b]], by[b, [a, b]] = [c / size, d / size], [-d / size**2, c / size**2]
    value[a], value[b] = size, np.arctan2(d, c)
    names = tuple({"Tg sin": "Tg", "Tg cos": "phi_g"}.get(n, n) for n in s.names)
    return s.changed(names, value, by)


def _iterated_phase(problem: _Problem, phi: float, Tg: float) -> ShaftFit:
    """Gauss–Newton for the phase where the amplitude is given: `phi_g` comes out as a change of the phase."""
    for _ in range(_PHASE_ROUNDS):
        shaft, _ = problem.solve((phi, Tg))
        if "phi_g" not in shaft.names:
            return shaft
        k = shaft.names.index("phi_g")
        phi += float(shaft.value[k])
        if abs(shaft.value[k]) < 1e-9:
            break
    value = shaft.value.copy()
    value[k] = phi
    return replace(shaft, value=value)


def blurred(a: ShaftFit, b: ShaftFit) -> ShaftFit:
    """Between two answers of the same regression that the data cannot decide between: half their distance is 1 σ."""
    if a.names != b.names:
        return a
    apart = np.outer(a.value - b.value, a.value - b.value) / 4
    return replace(a, value=(a.value + b.value) / 2, covariances=a.covariances + apart)
