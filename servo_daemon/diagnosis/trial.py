"""One candidate model: fitted to the training part, scored on the held-out part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.split import CARRIED, Split, divided
from servo_daemon.estimators.base import from_coordinate, to_coordinate
from servo_daemon.estimators.output_error import Recording
from servo_daemon.estimators.output_error.problem import Problem
from servo_daemon.estimators.output_error.rollout import free_run
from servo_daemon.estimators.output_error.setup import make_problem
from servo_daemon.estimators.output_error.solver import Solution, solve
from servo_daemon.plant.build import build_plant
from servo_daemon.samples import F64

#: A carried state at the beginning of a free run is known this well, in its unit.
_CARRIED_STD = 1e-3
#: Passes for models whose carried states depend on their parameters.
_PASSES = 2
_MOST_ITERATIONS = 40


@dataclass(frozen=True)
class Trial:
    """A fitted model and its held-out errors.

    Attributes:
        effects: of the model.
        values: natural units, every parameter.
        free: how many parameters were fitted.
        solution: of the fit to the training part.
        train, test: problems.
        squares: shape (h, c), sums of squared errors of each held-out segment and channel.
        counts: shape (h, c), their samples.
        residuals: held-out residuals, one array (n, c) for each held-out segment.
    """

    effects: tuple[str, ...]
    values: Mapping[str, float]
    free: int
    solution: Solution
    train: Problem
    test: Problem
    squares: F64
    counts: F64
    residuals: tuple[F64, ...]

    @cached_property
    def nrmse(self) -> float:
        """Root of the mean over channels of held-out mean square over the signal's."""
        mse = self.squares.sum(axis=0) / self.counts.sum(axis=0)
        return float(np.sqrt(np.mean(mse / self.test.spread**2)))

    @cached_property
    def rmse(self) -> dict[str, float]:
        """Held out, by channel, in its unit."""
        mse = self.squares.sum(axis=0) / self.counts.sum(axis=0)
        return {name: float(np.sqrt(v)) for name, v in zip(self.test.channels, mse, strict=True)}

    @cached_property
    def bic(self) -> float:
        """−2 log-likelihood of the training part + parameters × log(independent samples)."""
        return self.solution.point.value * self.independent + self.free * float(
            np.log(self.independent * float(self.train.counts.sum()))
        )

    @cached_property
    def independent(self) -> float:
        """Share of the training samples that are independent: correlated residuals count for fewer."""
        shares = []
        for c in range(len(self.train.channels)):
            parts = [
                r[:, c]
                for r, s in zip(self.solution.point.linearisation.residuals, self.train.segments, strict=True)
                if s.valid.any()
            ]
            power = sum(float(x @ x) for x in parts)
            lag = sum(float(x[1:] @ x[:-1]) for x in parts) / power if power else 0.0
            shares.append((1.0 - max(lag, 0.0)) / (1.0 + max(lag, 0.0)))
        return max(float(np.mean(shares)), 1e-3)


def fit_trial(
    recordings: Sequence[Recording],
    effects: tuple[str, ...],
    start: Mapping[str, float],
    fixed: Mapping[str, float],
    segment_s: float,
    mask: NDArray[np.bool_] | None = None,
) -> Trial | None:
    """Fit from one start and score; None where the model cannot be simulated from there.

    Args:
        start: every free parameter, natural units.
        fixed: held.
        mask: which segments are held out; None: none, and nothing is scored.

    Raises:
        BadInputError: see `make_problem`.
    """
    problem = make_problem(recordings, effects, fixed, segment_s=segment_s)
    values = {p.name: float(np.clip({**start, **fixed}[p.name], p.lower, p.upper)) for p in problem.plant.parameters}
    carried = [k for k, name in enumerate(problem.plant.state_names) if name in CARRIED]
    held = np.zeros(len(problem.segments), dtype=bool) if mask is None else mask
    solution: Solution | None = None
    for _ in range(_PASSES if carried else 1):
        problem = _with_carried(problem, recordings, carried, values)
        split = divided(problem, held)
        found = solve(split.train, split.train.start(_coordinates(problem, values)), max_iterations=_MOST_ITERATIONS)
        if found is None:
            return None
        solution, values = found, _natural(problem, found.point.unknowns)
    assert solution is not None
    squares, counts, residuals = _scored(split, solution.point.unknowns, held)
    free = len(problem.parameter_of_column)
    return Trial(effects, values, free, solution, split.train, split.test, squares, counts, residuals)


def _coordinates(problem: Problem, values: Mapping[str, float]) -> dict[str, float]:
    return {p.name: to_coordinate(p, values[p.name]) for p in problem.plant.parameters}


def _natural(problem: Problem, unknowns: F64) -> dict[str, float]:
    q = np.mean([problem.coordinates(unknowns, k) for k in range(problem.recordings)], axis=0)
    return {p.name: from_coordinate(p, float(c), 0.0)[0] for p, c in zip(problem.plant.parameters, q, strict=True)}


def _with_carried(
    problem: Problem, recordings: Sequence[Recording], carried: Sequence[int], values: Mapping[str, float]
) -> Problem:
    """Slow states go on from one free run to the next: they begin where a run over the whole recording has them."""
    if not carried:
        return problem
    q = np.array([_coordinates(problem, values)[n] for n in problem.plant.parameter_names])
    segments = []
    for number in range(len(recordings)):
        own = [s for s in problem.segments if s.recording == number]
        rows = np.ascontiguousarray(np.concatenate([s.rows for s in own]))
        _, path = free_run(problem.plant, problem.channels, q, own[0].x0, rows)
        at = 0
        for s in own:
            x0, scale = s.x0.copy(), s.x0_scale.copy()
            x0[carried], scale[carried] = path[at][carried], _CARRIED_STD / 100.0
            segments.append(replace(s, x0=x0, x0_scale=scale))
            at += len(s.rows)
    return replace(problem, segments=tuple(segments))


def _scored(split: Split, unknowns: F64, held: NDArray[np.bool_]) -> tuple[F64, F64, tuple[F64, ...]]:
    """The held-out segments, each from the initial state that suits it best with these parameters."""
    problem = split.test
    c = len(problem.channels)
    if not held.any():
        return np.zeros((0, c)), np.zeros((0, c)), ()
    given = dict(problem.given) | dict(zip(problem.free, unknowns, strict=False))
    if problem.local:
        mean = np.mean([problem.coordinates(unknowns, k) for k in range(problem.recordings)], axis=0)
        given |= dict(zip(problem.plant.parameter_names, mean, strict=True))
    states = replace(problem, free=(), local=(), given=given)
    found = solve(states, states.start({}), robust=False, max_iterations=12)
    if found is None:
        h = int(held.sum())
        return np.full((h, c), np.inf), np.ones((h, c)), ()
    parts = [r for r, out in zip(found.point.linearisation.residuals, held, strict=True) if out]
    squares = np.array([(r * r).sum(axis=0) for r in parts])
    counts = np.array([np.full(c, float(len(r))) for r in parts])
    return squares, counts, tuple(parts)


def model_exists(effects: tuple[str, ...]) -> bool:
    """Whether these effects can be in one model (two dry frictions cannot)."""
    from servo_daemon.errors import ConfigError

    try:
        build_plant(effects)
    except ConfigError:
        return False
    return True
