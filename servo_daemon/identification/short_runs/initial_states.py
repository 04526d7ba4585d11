"""Initial-state search for a load behind a gap: free runs of any length, each from the state that suits it best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.setup import Recording, make_problem
from servo_daemon.identification.short_runs.runs import FEWEST, SHORT, TWIST, Runs, can_be_searched, of_states, swing_s
from servo_daemon.identification.short_runs.search import settled_runs
from servo_daemon.identification.short_runs.states import searched
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.samples import F64

#: How exact a place is: a motor's state as a share of its size, a load's twist of the gap, its rate of the fastest.
_OF_MOTOR, _OF_GAP, _OF_RATE = 1e-3, 0.02, 0.02
#: Samples that tell the noise.
_FEW_SAMPLES = 5_000


def with_found_states(problem: Problem, values: Mapping[str, float]) -> Problem:
    """The same with every segment beginning in a state of its own that was searched for; as it was where there is no
    such load.

    Args:
        values: natural units, of every parameter that is not given by the problem.
    """
    if not can_be_searched(problem) or not problem.segments:
        return problem
    plant = problem.plant
    q = np.array(
        [
            problem.given[p.name] if p.name in problem.given else to_coordinate(p, values[p.name])
            for p in plant.parameters
        ]
    )
    runs = Runs.over(problem)
    _, sigma = settled_runs(runs.some(_FEW_SAMPLES), q)
    states = searched(runs, q, runs.guessed, sigma).states
    segments = tuple(replace(s, x0=x0) for s, x0 in zip(problem.segments, states, strict=True))
    return replace(problem, segments=segments, exact=False, own_states=plant.state_names, whole=())


def short_runs_with_found_states(
    problem: Problem, recordings: Sequence[Recording], values: Mapping[str, float]
) -> Problem:
    """A model in free runs in which the load meets its teeth about once, each from the state that was found; as it was
    where there is no such load.

    Args:
        problem: of these recordings, uncut, nothing of it given.
        values: natural units, of every parameter.
    """
    if not can_be_searched(problem):
        return problem
    length_s = max(SHORT * swing_s(values), FEWEST * problem.sample_period_s)
    return with_found_states(make_problem(recordings, problem.plant.effects, {}, segment_s=length_s), values)


def has_found_states(problem: Problem) -> bool:
    """Whether its segments begin in states that were searched for."""
    return TWIST in problem.own_states


def found_states_std(problem: Problem, q: F64) -> F64:
    """1 σ of the states that were found for the segments to begin in, shape (nx,).

    Args:
        q: shape (np,) or longer, the plant's coordinates.
    """
    return of_states(problem.plant, problem.segments[0].x0_scale, q, (_OF_MOTOR, _OF_GAP, _OF_RATE))
