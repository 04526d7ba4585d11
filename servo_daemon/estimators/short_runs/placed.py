"""Free runs of any length with the load where it suits each of them best."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from servo_daemon.estimators.base import to_coordinate
from servo_daemon.estimators.output_error.problem import Problem
from servo_daemon.estimators.short_runs.runs import TWIST, Runs, can_be_searched
from servo_daemon.estimators.short_runs.search import settled_runs
from servo_daemon.estimators.short_runs.states import searched

#: Samples that tell the noise.
_FEW_SAMPLES = 5_000


def placed(problem: Problem, values: Mapping[str, float]) -> Problem:
    """The same with every segment beginning where its load is, all its states its own; as it was where there is no such
    load.

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


def is_placed(problem: Problem) -> bool:
    """Whether its segments begin with a load of their own."""
    return TWIST in problem.own_states
