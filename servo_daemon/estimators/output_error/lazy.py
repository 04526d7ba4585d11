"""Residuals at once, their derivatives when they are asked for: exact ones, or differences.

Most points that a search tries are only compared with another. With a second inertia behind a gap the sensitivities
cost ten times as much as the simulation itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from servo_daemon.estimators.output_error.rollout import simulate
from servo_daemon.samples import F64

if TYPE_CHECKING:
    from servo_daemon.estimators.output_error.problem import Problem

#: Forward differences: share of an unknown's size; a parameter that may be zero is at least so large.
_DIFFERENCE, _LEAST_SIZE = 1e-5, 1e-3


@dataclass(frozen=True)
class Lazy:
    """A `Linearised` point of this problem."""

    problem: Problem
    unknowns: F64
    residuals: tuple[F64, ...]
    finite: bool

    @cached_property
    def jacobian(self) -> tuple[F64, ...]:
        """Per segment, shape (n, c, k); zero where a derivative leaves the range of numbers, which is the end of a way
        and no step."""
        problem = self.problem
        chosen = [problem.plant.parameter_names.index(n) for n in (*problem.free, *problem.local)]
        out = []
        for k, segment in enumerate(problem.segments):
            q, x0 = problem.coordinates(self.unknowns, segment.recording), problem.initial_state(self.unknowns, k)
            with np.errstate(over="ignore", invalid="ignore"):
                run = simulate(problem.plant, problem.channels, q, x0, segment.rows)
            jacobian = np.concatenate([run.by_parameter[:, :, chosen], run.by_state], axis=2)
            if not segment.valid.all():
                jacobian = jacobian * segment.valid[:, :, None]
            good = bool(np.isfinite(run.last).all() and np.isfinite(jacobian).all())
            out.append(jacobian if good else np.zeros_like(jacobian))
        return tuple(out)


@dataclass(frozen=True)
class Differenced:
    """The same by forward differences of the simulation, when they are asked for: one more simulation for each unknown,
    but of code that compiles ten times as fast as the sensitivities'. For models that are tried once."""

    problem: Problem
    unknowns: F64
    residuals: tuple[F64, ...]
    finite: bool

    @cached_property
    def jacobian(self) -> tuple[F64, ...]:
        """Per segment, shape (n, c, k)."""
        problem = self.problem
        out = [np.zeros((*r.shape, len(problem.columns(k)))) for k, r in enumerate(self.residuals)]
        for k in range(len(problem.parameter_of_column)):
            size = 1.0 if problem.logarithmic[k] else abs(float(self.unknowns[k]))
            self._difference(out, k, _DIFFERENCE * max(size, _LEAST_SIZE))
        carried = problem.carried(self.unknowns)
        for index, segment in enumerate(problem.segments):
            where = problem.columns(index)
            for state, name in enumerate(problem.plant.state_names):
                if name in problem.own_states:
                    column = len(where) - len(problem.plant.states) + state
                    ahead, step = self.unknowns.copy(), _DIFFERENCE * float(segment.x0_scale[state])
                    ahead[where[column]] += step
                    slope = (self.residuals[index] - problem.residual(ahead, index, carried[index])) / step
                    out[index][:, :, column] = slope
        return tuple(out)

    def _difference(self, out: list[F64], k: int, step: float) -> None:
        """One parameter's column of every segment."""
        ahead = self.unknowns.copy()
        ahead[k] += step
        carried = self.problem.carried(ahead)
        for index, here in enumerate(self.residuals):
            column = np.flatnonzero(self.problem.columns(index) == k)
            if len(column):
                out[index][:, :, column[0]] = (here - self.problem.residual(ahead, index, carried[index])) / step
