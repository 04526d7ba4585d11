"""Residuals at once, their derivatives when they are asked for: exact ones, or differences.

Most points that a search tries are only compared with another. With a second inertia behind a gap the sensitivities
cost ten times as much as the simulation itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.rollout import free_runs, simulate_many
from servo_daemon.plant.c_code.lanes import LANES
from servo_daemon.samples import F64

#: Forward differences: share of an unknown's size; a parameter that may be zero is at least so large.
_DIFFERENCE, _LEAST_SIZE = 1e-5, 1e-3


class Linearised(Protocol):
    """Residuals and derivatives at one point; see `Linearisation`."""

    @property
    def residuals(self) -> tuple[F64, ...]:
        """Per segment, shape (n, c)."""

    @property
    def jacobian(self) -> tuple[F64, ...]:
        """Per segment, shape (n, c, k)."""

    @property
    def finite(self) -> bool:
        """Whether the simulation stayed in range."""


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Residuals and derivatives at one point.

    Attributes:
        residuals: per segment, shape (n, c), measured − shown; 0 where not valid.
        jacobian: per segment, shape (n, c, k), of what is shown by `columns` of that segment.
        finite: whether the simulation stayed in range.
    """

    residuals: tuple[F64, ...]
    jacobian: tuple[F64, ...]
    finite: bool


def linearise(problem: Problem, unknowns: F64) -> Linearised:
    """Simulate every segment; derivatives, as `problem.exact` says, when they are asked for."""
    residuals = problem.residuals(unknowns, problem.starts(unknowns, problem.carried(unknowns)))
    finite = all(bool(np.isfinite(r).all()) for r in residuals)
    return (Lazy if problem.exact else Differenced)(problem, unknowns, residuals, finite)


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
        problem, starts = self.problem, self.problem.initial_states(self.unknowns)
        chosen = [problem.plant.parameter_names.index(n) for n in (*problem.free, *problem.local)]
        out = [np.empty(0)] * len(problem.segments)
        for recording, which, rows in problem.alike:
            q = problem.acting(self.unknowns, recording)
            with np.errstate(over="ignore", invalid="ignore"):
                runs = simulate_many(problem.plant, problem.channels, q, starts[which], rows)
            slopes = np.concatenate([runs.by_parameter[..., chosen], runs.by_state], axis=3)
            if recording in problem.blocked:  # not even by rounding
                slopes[..., problem.of_the_motion] = 0.0
            for k, last, slope in zip(which.tolist(), runs.last, slopes, strict=True):
                jacobian = slope if problem.segments[k].valid.all() else slope * problem.segments[k].valid[:, :, None]
                good = bool(np.isfinite(last).all() and np.isfinite(jacobian).all())
                out[k] = jacobian if good else np.zeros_like(jacobian)
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
        out = tuple(np.zeros((*r.shape, len(problem.columns(k)))) for k, r in enumerate(self.residuals))
        for recording in range(problem.recordings):
            own = problem.n_shared + len(problem.local) * recording
            columns = [*range(problem.n_shared), *range(own, own + len(problem.local))]
            for first in range(0, len(columns), LANES):
                self._by_parameters(out, columns[first : first + LANES], first, recording)
        starts = problem.starts(self.unknowns, problem.carried(self.unknowns))
        for state, name in enumerate(problem.plant.state_names):
            if name in problem.own_states:
                self._by_state(out, state, starts)
        return out

    def _by_parameters(self, out: Sequence[F64], which: Sequence[int], first: int, recording: int) -> None:
        """Some parameters' columns, from this one on, of every segment of a recording."""
        points, steps = [], []
        for k in which:
            size = 1.0 if self.problem.logarithmic[k] else abs(float(self.unknowns[k]))
            points.append(self.unknowns.copy())
            steps.append(_DIFFERENCE * max(size, _LEAST_SIZE))
            points[-1][k] += steps[-1]
        for index, there in _residuals(self.problem, points, recording):
            for column, (moved, step) in enumerate(zip(there, steps, strict=True), start=first):
                out[index][:, :, column] = (self.residuals[index] - moved) / step

    def _by_state(self, out: Sequence[F64], state: int, starts: F64) -> None:
        """One initial state's column of every segment."""
        problem, ahead = self.problem, starts.copy()
        steps = [_DIFFERENCE * float(s.x0_scale[state]) for s in problem.segments]
        ahead[:, state] += steps
        for index, moved in enumerate(problem.residuals(self.unknowns, ahead)):
            column = out[index].shape[2] - len(problem.plant.states) + state
            out[index][:, :, column] = (self.residuals[index] - moved) / steps[index]


def without_derivatives(linear: Linearised) -> Linearised:
    """The same point without the derivatives, which are most of what it holds: of a simulation they are taken anew if
    they are asked for again."""
    if isinstance(linear, Lazy | Differenced):
        return replace(linear)
    return Linearisation(linear.residuals, (), linear.finite)


def _residuals(problem: Problem, points: Sequence[F64], recording: int) -> Iterator[tuple[int, F64]]:
    """Residuals of a recording at several points, simulated at once: number of a segment, shape (m, n, c)."""
    paths, m = problem.paths(points, recording), len(points)
    q = np.stack([problem.acting(unknowns, recording) for unknowns in points])
    for (of, which, rows), (measured, valid) in zip(problem.alike, problem.measured, strict=True):
        if of != recording:
            continue
        starts = []
        for unknowns, path in zip(points, paths, strict=True):
            carried = [path[s.begin] if len(path) and s.recording == of else None for s in problem.segments]
            starts.append(problem.starts(unknowns, carried)[which])
        own, runs = np.repeat(q, len(which), axis=0), np.tile(rows, (m, 1, 1))
        shown = free_runs(problem.plant, problem.channels, own, np.concatenate(starts), runs)
        left = np.where(valid, measured - shown.reshape(m, *measured.shape), 0.0)
        yield from zip(which.tolist(), left.swapaxes(0, 1), strict=True)
