"""The shaft's balance with some supposed torques in it, as a regression over measured motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.inverse.rows import BalanceRows
from servo_daemon.diagnosis.trial.scored import Scored
from servo_daemon.diagnosis.trial.split import TRAIN
from servo_daemon.numerics import least_squares
from servo_daemon.plant.effects import dry_frictions
from servo_daemon.regression.linear_regression import autocorrelation
from servo_daemon.samples import F64

#: An offset is always allowed for and never named: a constant load, the current sensor's zero, or, where the motion
#: never reverses, dry friction.
OFFSET = "constant_load_torque"
#: The motor's own columns: inertia, viscous friction, and an offset of either sign.
OWN = ("J", "B", "TL")
#: Of these, the first that cannot be negative.
_POSITIVE = 2

#: Less of a row is rest than this, and it is one of motion (chosen; not tried).
_MOVES = 0.01

#: From the coefficients of an effect's columns to its parameters, natural units; None: there are none.
Start = Callable[[F64], Mapping[str, float] | None]


@dataclass(frozen=True, eq=False)
class Torque:
    """A supposed torque.

    Attributes:
        name: of its cause.
        effects: that it takes: several harmonics are several effects.
        columns: shape (w, m).
        start: see `Start`.
        parameters: how many it has, scanned ones included.
    """

    name: str
    effects: tuple[str, ...]
    columns: F64
    start: Start
    parameters: int

    def without(self, number: int) -> Torque | None:
        """Less one of its effects, each of which has as many columns; None: nothing is left."""
        if len(self.effects) == 1:
            return None
        each = self.columns.shape[1] // len(self.effects)
        kept = [k for k in range(self.columns.shape[1]) if k // each != number]
        return replace(self, columns=self.columns[:, kept], start=lambda _: None)


@dataclass(frozen=True, eq=False)
class Explained:
    """The balance with some torques in it, fitted to the part for fitting."""

    rows: BalanceRows
    torques: tuple[Torque, ...]

    @cached_property
    def table(self) -> F64:
        """Columns of the motor and of the torques, shape (w, ·)."""
        return np.column_stack([own_columns(self.rows), *(t.columns for t in self.torques)])

    @cached_property
    def coefficients(self) -> F64:
        here = self.rows.at(TRAIN) & self.told
        return non_negative(self.table[here], self.rows.torque[here])

    @cached_property
    def told(self) -> NDArray[np.bool_]:
        """Rows of which the torque is told: with a dry friction those of motion, if there are enough, shape (w,)."""
        moving = self.rows.rest < _MOVES
        sticks = any(t.name in dry_frictions() for t in self.torques)
        enough = np.count_nonzero(moving & self.rows.at(TRAIN)) > self.table.shape[1]
        return moving if sticks and enough else np.ones_like(moving)

    @cached_property
    def residual(self) -> F64:
        """Residual of the fit, N·m, shape (w,)."""
        return np.asarray(self.rows.torque - self.table @ self.coefficients)

    @cached_property
    def error(self) -> F64:
        """What of the residual is neither a step of the reading nor what a shaft that sticks takes, N·m, shape (w,)."""
        free = self.rows.unread + self.rows.rest * sum(self._holds(t) for t in self.torques)
        return np.asarray(np.sign(self.residual) * np.maximum(np.abs(self.residual) - free, 0.0))

    def _holds(self, torque: Torque) -> float:
        """The most that a dry friction holds at rest without motion, N·m: what it takes in motion; 0 of others."""
        moving = self.rows.rest < _MOVES
        if torque.name not in dry_frictions() or not moving.any():
            return 0.0
        taken = torque.columns[moving] @ self.coefficients[self.columns_of(torque)]
        return float(np.median(np.abs(taken)))

    def scored(self, part: int) -> Scored:
        """Errors by free run of a part, in the unit of the measured effort."""
        here = self.rows.at(part)
        runs, number = np.unique(self.rows.run[here], return_inverse=True)
        squares = np.bincount(number, (self.error[here] / self.rows.factor) ** 2, len(runs)).astype(np.float64)
        counts = np.bincount(number, minlength=len(runs)).astype(np.float64)
        effort = self.rows.torque[self.rows.run >= 0] / self.rows.factor
        return Scored(squares[:, None], counts[:, None], np.array([max(float(np.std(effort)), 1e-300)]))

    def parameters_of(self, torque: Torque) -> Mapping[str, float] | None:
        """Parameters of the torque from its coefficients; None: they are not physical."""
        return torque.start(self.coefficients[self.columns_of(torque)])

    def columns_of(self, torque: Torque) -> slice:
        """Where its columns are in the table."""
        k = self.torques.index(torque)
        begin = len(OWN) + sum(t.columns.shape[1] for t in self.torques[:k])
        return slice(begin, begin + torque.columns.shape[1])

    @property
    def independent(self) -> float:
        """Share of the rows that count as independent samples."""
        rho = float(np.clip(autocorrelation(self.residual[self.rows.at(TRAIN)]), 0.0, 0.999))
        return (1.0 - rho) / (1.0 + rho)


def own_columns(rows: BalanceRows) -> F64:
    """Regressors of J, B and an offset, shape (w, 3)."""
    return np.column_stack([rows.filtered(c) for c in own_torques(rows)])


def own_torques(rows: BalanceRows) -> tuple[F64, F64, F64]:
    return rows.motion.omega_rate, rows.motion.omega, np.ones(len(rows.motion.omega))


def non_negative(table: F64, y: F64) -> F64:
    """Least squares; an inertia or a viscous friction below zero is none."""
    scale = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
    used = np.ones(table.shape[1], dtype=bool)
    while True:
        beta = np.zeros(table.shape[1])
        beta[used] = least_squares(table[:, used], y)[0]
        if not (beta[:_POSITIVE] < 0).any():
            return beta
        used[int(np.argmin(beta[:_POSITIVE] * scale[:_POSITIVE]))] = False
