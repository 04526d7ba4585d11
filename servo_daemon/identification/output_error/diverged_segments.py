"""Diverged segments: free runs that began in the wrong place.

Beside a point where the motor cannot stand (a rotor between two detents) a run turns one way or the other, and no small
change of its initial state leads across. A fit in which a few runs went the wrong way follows these and not the motor.
Their states are found again from their beginnings, where they cannot yet have gone astray.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.solver.solver import Solution, solve
from servo_daemon.samples import F64

#: Iterations that look for a segment's initial states at most (chosen; not tried).
_STATE_ITERATIONS = 8
#: A fit is over when an iteration lowers V by less than this per value: the RMS by half of it.
ENOUGH = 1e-4
#: A run whose sum of squares is so many times the median of its channel may have diverged from a wrong initial state;
#: that is then fitted to these shares of the run's beginning, one after the other.
_DIVERGED, _GROWING = 25.0, (0.2, 0.5)
#: Least error of a run, as a share of its signal's square: a median of 0 would make every run diverged.
_NOTHING = 1e-12
#: Samples that tell an initial state.
_FEWEST = 12


def settled(problem: Problem) -> Solution | None:
    """Free runs whose parameters are given, from the initial states that suit them best."""
    return solve(
        problem,
        problem.start({}),
        robust=False,
        max_iterations=_STATE_ITERATIONS,
        enough=ENOUGH * float(problem.counts.sum()),
        curved=False,
    )


def error_of(residuals: F64, spread: F64) -> float:
    """Sum of a run's squared residuals, each over the size of its channel."""
    return float(np.sum(np.square(residuals / spread)))


def diverged(squares: F64, spread: F64) -> list[int]:
    """Numbers of the runs whose errors are far beyond those of the others."""
    usual = np.maximum(np.median(squares, axis=0), (_NOTHING * spread) ** 2)
    return [int(k) for k in np.flatnonzero((squares > _DIVERGED * usual).any(axis=1))]


def grown(problem: Problem, number: int) -> tuple[F64, F64] | None:
    """Initial state of a run and what it leaves, shapes (n_x,), (n, c), if the state is found on its beginning first,
    where the run cannot yet have gone astray; None: it cannot be simulated.

    Args:
        problem: with all parameters given.
    """
    whole = problem.segments[number]
    x0, left = whole.x0, None
    for share in (*_GROWING, 1.0):
        end = max(int(share * len(whole.rows)), min(_FEWEST, len(whole.rows)))
        part = replace(whole, rows=whole.rows[:end], measured=whole.measured[:end], valid=whole.valid[:end], x0=x0)
        alone = replace(problem, segments=(part,))
        found = settled(alone)
        if found is None:
            return None
        x0, left = alone.initial_state(found.point.unknowns, 0), found.point.linearisation.residuals[0]
    return None if left is None else (x0, left)


def begun_again(problem: Problem, found: Solution) -> F64 | None:
    """The unknowns of a fit with the initial states of its diverged runs found anew; None: no run is the better for
    it."""
    point, spread = found.point, problem.spread
    residuals = point.linearisation.residuals
    squares = np.array([(r * r).sum(axis=0) for r in residuals])
    unknowns = point.unknowns.copy()
    states = len(problem.plant.states)
    first, better = len(problem.parameter_of_column), False
    for k in diverged(squares, spread):
        q = problem.acting(point.unknowns, problem.segments[k].recording)
        given = dict(problem.given) | dict(zip(problem.plant.parameter_names, q, strict=True))
        again = grown(replace(problem, free=(), local=(), given=given), k)
        if again is not None and error_of(again[1], spread) < 0.5 * error_of(residuals[k], spread):
            unknowns[first + k * states : first + (k + 1) * states] = again[0]
            better = True
    return unknowns if better else None
