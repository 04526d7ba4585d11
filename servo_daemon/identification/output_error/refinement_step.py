"""One step of `refine`: Gauss–Newton on whitened residuals, damped or shortened until it is better."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error.problem.linearisation import linearise
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.solver.solver import (
    Point,
    in_units_of_each,
    normal_equations,
    point_of,
    within,
)
from servo_daemon.identification.output_error.whitened_point import whitened_value
from servo_daemon.samples import F64

#: Most trials of a step, and most halvings.
_TRIALS, _HALVINGS = 8, 6
#: Least damping (from 1e-3 a spring's valley took more than thirty steps), and by how much it grows and falls
#: (Marquardt 1963).
_LEAST_DAMPING, _DAMPED = 1e-5, 10.0
#: Directions of which the data know less than this (1/σ², σ of three e-folds) stay: a friction near zero.
FAINT = 0.1
#: No logarithm moves by more in one step, unless it grows from next to nothing: there the model is linear in the
#: parameter itself, and the step is taken in that (an L that a free run has left at a thousandth of itself).
_LONGEST = 0.5


def newton_step(problem: Problem, whitened: Point, held: Sequence[int] = (), damping: float = 0.0) -> tuple[F64, float]:
    """The Gauss–Newton step and what it promises, in units of −2 log p.

    Args:
        damping: of each unknown, as a share of what the data know of it (Marquardt 1963).
        held: columns that stay. What the slope by an event time promises ends at the next sample (`event_times`): no
            search waits for it to be kept.
    """
    H, g = normal_equations(problem, whitened)
    H = H + np.diag(np.where(problem.logarithmic, FAINT, 0.0))
    free = ~held_at_bounds(problem, whitened.unknowns, g) & (np.diag(H) > 0)
    free[list(held)] = False
    A, size = in_units_of_each(H[np.ix_(free, free)])
    A += damping * np.eye(len(A))
    step = np.zeros(len(g))
    step[free] = np.linalg.solve(A, g[free] / size) / size
    return step, float(g @ step)


def held_at_bounds(problem: Problem, unknowns: F64, g: F64) -> NDArray[np.bool_]:
    """Unknowns at a bound that would go beyond it."""
    low, high = problem.bounds_at(unknowns)
    return np.asarray((unknowns <= low) & (g < 0) | (unknowns >= high) & (g > 0))


def downhill(problem: Problem, here: tuple[Point, Point], a: F64, damping: float) -> tuple[Point | None, float]:
    """After a damped step that is better than this place, and the damping of the next; None: none is, up to the
    largest. Damping follows a valley that is curved, which a step that is only made shorter leaves to the side."""
    point, whitened = here
    for tried in range(_TRIALS):
        step, _ = newton_step(problem, whitened, damping=damping)
        trial = moved_by(problem, point, limited(problem, step))
        if trial is not None and whitened_value(problem, trial, a) < whitened.value:
            return trial, damping if tried else damping / _DAMPED
        damping = max(damping * _DAMPED, _LEAST_DAMPING)
    return None, damping


def shortened(problem: Problem, here: tuple[Point, Point], a: F64, step: F64) -> Point | None:
    """The first point along the step, halved at most `_HALVINGS` times, that is better than this place."""
    point, whitened = here
    step = limited(problem, step)
    for halved in range(_HALVINGS):
        trial = moved_by(problem, point, step / 2**halved)
        if trial is not None and whitened_value(problem, trial, a) < whitened.value:
            return trial
    return None


def limited(problem: Problem, step: F64) -> F64:
    """A step with no logarithm moved by more than it may be."""
    grown = np.log1p(np.maximum(step, 0.0))
    return np.where(problem.logarithmic, np.clip(step, -_LONGEST, np.maximum(grown, _LONGEST)), step)


def moved_by(problem: Problem, point: Point, step: F64) -> Point | None:
    """The point after a step; None: it cannot be simulated."""
    unknowns = within(problem, point.unknowns + step)
    with np.errstate(over="ignore", invalid="ignore"):
        linear = linearise(problem, unknowns)
    return point_of(problem, unknowns, linear, point.weights) if linear.finite else None
