"""One candidate model: fitted to some of the free runs, scored on others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.scored import Scored, scored_states
from servo_daemon.diagnosis.trial.split import CHOICE, TRAIN, Split
from servo_daemon.errors import ConfigError, NumericalError
from servo_daemon.identification.output_error.diverged_segments import ENOUGH, begun_again
from servo_daemon.identification.output_error.problem.linearisation import without_derivatives
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.problem.setup import carrying
from servo_daemon.identification.output_error.solver.solver import Point, Solution, solve
from servo_daemon.identification.output_error.starts import starting_points
from servo_daemon.identification.short_runs.initial_states import has_found_states, with_found_states
from servo_daemon.kalman.gaussian import natural_values, to_coordinate
from servo_daemon.parameters import Parameter
from servo_daemon.plant.effects import check_effects, effects_by_name
from servo_daemon.plant.effects.base import LATE_STEPS, TWIST
from servo_daemon.samples import F64

#: Of a fit: from each of several starts, and from the best of these (chosen; not tried).
_START_ITERATIONS, _MOST_ITERATIONS = 3, 25
#: Iterations that every candidate gets, and every fit that must beat another of the same model (chosen; not tried).
FIRST_ITERATIONS = 5
#: Samples of all free runs together: of longer captures each run is only begun, so that a search takes no longer; the
#: fit that is published sees all of them. And the least of one run.
MOST_SAMPLES, _LEAST_SAMPLES = 24_000, 40


#: An L/R of this share of the sample period and a viscous friction of this share of the braking K²/R can be seen
#: (chosen; not tried).
_SEEN_LAG, _SEEN_BRAKING = 0.1, 0.01


@dataclass(frozen=True)
class Trial:
    """A model fitted to some parts.

    Attributes:
        effects: of the model.
        values: natural units, every parameter.
        held: parameters that the search holds: counts and choices, natural units.
        problem: every segment of the recordings.
        fitted: the segments that were fitted.
        solution: of that fit.
        split: which segments are in which part.
    """

    effects: tuple[str, ...]
    values: Mapping[str, float]
    held: Mapping[str, float]
    problem: Problem
    fitted: Problem
    solution: Solution
    split: Split

    @property
    def free(self) -> int:
        """How many parameters were fitted; a load's place in every run is two."""
        own = len(TWIST) * len(self.fitted.segments) if has_found_states(self.fitted) else 0
        return len(self.problem.parameter_of_column) + own

    def coordinates(self, recording: int = 0) -> F64:
        """The plant's parameter vector in coordinates, shape (np,)."""
        return self.fitted.coordinates(self.solution.point.unknowns, recording)

    @cached_property
    def independent(self) -> float:
        """Share of the fitted samples that are independent: correlated residuals count for fewer."""
        shares = []
        for c in range(len(self.fitted.channels)):
            parts = [r[:, c] for r in self.solution.point.linearisation.residuals]
            power = sum(float(x @ x) for x in parts)
            lag = sum(float(x[1:] @ x[:-1]) for x in parts) / power if power else 0.0
            shares.append((1.0 - max(lag, 0.0)) / (1.0 + max(lag, 0.0)))
        return max(float(np.mean(shares)), 1e-3)

    @cached_property
    def choice(self) -> Scored:
        """Errors of the part that decides."""
        return self.scored(CHOICE)

    @cached_property
    def held_out(self) -> Scored:
        """Errors of the part that the gain is measured on."""
        return self.scored(self.split.measuring)

    def scored(self, part: int) -> Scored:
        """Every free run of a part from the initial state that suits it best with these parameters."""
        return scored_states(self.states(part))

    def states(self, part: int) -> Problem:
        """Problem of a part with these parameters, of which only initial states are free."""
        chosen = self.split.of(part)
        given = dict(self.problem.given) | dict(
            zip(self.problem.plant.parameter_names, self.mean_coordinates, strict=True)
        )
        segments = tuple(self.problem.segments[int(k)] for k in chosen)
        problem = replace(self.problem, segments=segments, free=(), local=(), given=given)
        return with_found_states(problem, {}) if has_found_states(self.fitted) else problem

    @cached_property
    def mean_coordinates(self) -> F64:
        """Offsets that every recording has for itself: their mean."""
        return self.fitted.mean_coordinates(self.solution.point.unknowns)


def fit_trial(
    data: Data,
    effects: tuple[str, ...],
    start: Mapping[str, float],
    *,
    parts: Sequence[int] = (TRAIN,),
    like: Trial | None = None,
    max_iterations: int = _MOST_ITERATIONS,
    careful: bool = False,
    rival: Trial | None = None,
) -> Trial | None:
    """Fit from one start; None where the model cannot be simulated from there.

    Args:
        start: every parameter, natural units.
        parts: what is fitted.
        like: a trial over the same parts, whose initial states are a good start.
        careful: go on until the end is sharp, along narrow valleys, too: for the model that the others must beat.
        rival: a fit of the same model to the same runs. Given up where this one is still worse after a few iterations.

    Raises:
        BadInputError: see `make_problem`.
    """
    held = {p.name: start[p.name] for p in _counts_and_choices(effects) if p.name not in data.fixed}
    problem = data.problem(effects, held)
    segments = tuple(_settled(s, MOST_SAMPLES // len(problem.segments)) for s in problem.segments)
    problem = carrying(replace(problem, segments=segments), data.recordings)
    values = {
        p.name: float(np.clip({**start, **data.fixed}[p.name], p.lower, p.upper)) for p in problem.plant.parameters
    }
    values |= _lifted(values, problem)
    chosen = data.split.of(*parts)
    problem = _begun_like(problem, like, chosen)
    fitted = replace(problem, segments=tuple(problem.segments[int(k)] for k in chosen))
    if max_iterations >= _MOST_ITERATIONS:  # else it is only looked at
        fitted = with_found_states(fitted, values)
    start_at = fitted.start({p.name: to_coordinate(p, values[p.name]) for p in problem.plant.parameters})
    found = _solved(fitted, start_at, max_iterations, careful, rival)
    if found is None:
        return None
    point = replace(found.point, linearisation=without_derivatives(found.point.linearisation))
    found = replace(found, point=point)
    return Trial(effects, _natural(fitted, point.unknowns), held, problem, fitted, found, data.split)


def _lifted(values: Mapping[str, float], problem: Problem) -> dict[str, float]:
    """Free L and B that a simpler model has driven to nothing, at values that can be seen: the logarithm of nothing has
    no slope, and whatever else the model gets, it would stay there."""
    if not {"R", "L", "K", "B"} <= set(values):
        return {}
    least = {
        "L": _SEEN_LAG * problem.sample_period_s * values["R"],
        "B": _SEEN_BRAKING * values["K"] ** 2 / values["R"],
    }
    return {name: low for name, low in least.items() if name in problem.free and values[name] < low}


def _solved(problem: Problem, start: F64, max_iterations: int, careful: bool, rival: Trial | None) -> Solution | None:
    """The fit; one that goes to its end once more if some of its runs had only begun in the wrong place."""

    def solution(unknowns: F64) -> Solution | None:
        enough = (0.02 if careful else 1.0) * ENOUGH * float(problem.counts.sum())
        give_up = None if rival is None else _still_worse(rival)
        return solve(problem, unknowns, max_iterations=max_iterations, give_up=give_up, enough=enough, curved=careful)

    found = solution(start)
    if found is None or max_iterations < _MOST_ITERATIONS or (again := begun_again(problem, found)) is None:
        return found
    other = solution(again)
    return found if other is None or other.point.value > found.point.value else other


def _still_worse(rival: Trial) -> Callable[[Point], bool]:
    """Whether a fit has had its chance and is worse than another one."""
    number = count(1)
    return lambda point: next(number) >= FIRST_ITERATIONS and point.value > rival.solution.point.value


def first_trial(data: Data, effects: tuple[str, ...], nominal: Mapping[str, float]) -> Trial:
    """The baseline, from the best of the starts that a fit would try.

    Raises:
        BadInputError: see `make_problem`.
        NumericalError: no start can be simulated.
    """
    choices = {p.name: nominal.get(p.name, p.nominal) for p in _counts_and_choices(effects)}
    problem = data.problem(effects, {n: v for n, v in choices.items() if n not in data.fixed})
    # A regression over windows takes what the model lacks for its parameters: a better end, and further from the motor.
    starts = starting_points(data.recordings, problem, {**choices, **nominal, **data.fixed}, windows=False)
    begun = [t for s in starts if (t := fit_trial(data, effects, s.values, max_iterations=_START_ITERATIONS))]
    if not begun:
        raise NumericalError("the motor cannot be simulated over these data from any start: values out of range?")
    best = sorted(begun, key=lambda t: t.solution.point.value)[:2]
    ends = [t for b in best if (t := fit_trial(data, effects, b.values, like=b, careful=True))]
    return min([*best, *ends], key=lambda t: t.solution.point.value)


def _counts_and_choices(effects: Sequence[str]) -> list[Parameter]:
    known = effects_by_name()
    return [p for name in effects for p in known[name].parameters if p.held == "always"]


def _settled(segment: Segment, most: int) -> Segment:
    """Its first `most` samples (never less than a fit needs), and of these not the very first: what a late sensor shows
    there belongs to the segment before."""
    end = max(most, _LEAST_SAMPLES)
    valid = segment.valid[:end].copy()
    valid[: LATE_STEPS + 1] = False
    return replace(segment, rows=segment.rows[:end], measured=segment.measured[:end], valid=valid)


def _natural(problem: Problem, unknowns: F64) -> dict[str, float]:
    return natural_values(problem.plant.parameters, problem.mean_coordinates(unknowns))


def _begun_like(problem: Problem, like: Trial | None, chosen: NDArray[np.intp]) -> Problem:
    """Initial states from a trial over the same segments, where both models have the state."""
    if like is None or len(like.fitted.segments) != len(chosen):
        return problem
    mine, theirs = problem.plant.state_names, like.problem.plant.state_names
    shared = [(mine.index(n), theirs.index(n)) for n in mine if n in theirs]
    segments = list(problem.segments)
    for at, k in enumerate(chosen.tolist()):
        x0 = segments[k].x0.copy()
        found = like.fitted.initial_state(like.solution.point.unknowns, at)
        for a, b in shared:
            x0[a] = found[b]
        segments[k] = replace(segments[k], x0=x0)
    return replace(problem, segments=tuple(segments))


def model_exists(effects: tuple[str, ...]) -> bool:
    """Whether these effects can be in one model (two dry frictions cannot)."""
    try:
        check_effects(effects)
    except ConfigError:
        return False
    return True
