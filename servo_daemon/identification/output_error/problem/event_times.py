"""Event times by the likelihood's profile.

The derivative by the time of a step knows the sample in which it lies and no other. Where little flows at that very
sample a descent stays there, however much likelier another time would make the data; and its Fisher information says
nothing of how well the time is known: −2 log p falls towards the true one along a random walk with drift, and the
distance at which that has become likelier by one grows with the square of the noise and not with the noise (Hinkley,
*Biometrika* 57, 1970). So the likelihood is looked at at times in growing distances on either side, and is its own
standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.rollout import TIME
from servo_daemon.plant.effects import event_times
from servo_daemon.samples import F64

#: Distances from the best time: one sample, and each so many times the one before.
_GROWTH = 3.0
#: How often a better time may be gone on from.
_MOVES = 6


def event_times_of(problem: Problem) -> tuple[int, ...]:
    """Columns of the free event times whose step is free as well."""
    free = problem.free
    return tuple(dict.fromkeys(free.index(at) for size, at in event_times().items() if at in free and size in free))


def profile(problem: Problem, column: int, at_s: float, deviance: Callable[[float], float]) -> tuple[float, float]:
    """The likeliest event time, and its standard deviation.

    Args:
        column: of the event time.
        at_s: from this one.
        deviance: −2 log p with the event there; infinite where that cannot be simulated.

    Returns:
        both in s; the standard deviation is that of the likelihood about the likeliest time.
    """
    low, high = problem.bounds[0][column], min(float(problem.bounds[1][column]), _end_s(problem))
    period_s = problem.sample_period_s
    count = int(np.log(max((high - low) / period_s, _GROWTH)) / np.log(_GROWTH)) + 1
    distances = period_s * _GROWTH ** np.arange(count)
    known: dict[float, float] = {at_s: deviance(at_s)}
    for _ in range(_MOVES):
        best = min(known, key=known.__getitem__)
        around = [float(np.clip(best + d, low, high)) for d in (*-distances, *distances)]
        known |= {t: deviance(t) for t in around if t not in known}
        if min(known, key=known.__getitem__) == best:
            break
    best = min(known, key=known.__getitem__)
    return best, float(np.hypot(_spread(known, best), period_s / np.sqrt(12.0)))


def _end_s(problem: Problem) -> float:
    return max(float(s.rows[-1, TIME]) for s in problem.segments)


def _spread(known: dict[float, float], best: float) -> float:
    """Root mean square distance from the best under the likelihood, by trapezoids."""
    at: F64 = np.array(sorted(known))
    weight = np.exp(-0.5 * (np.array([known[t] for t in at.tolist()]) - known[best]))
    return float(np.sqrt(np.trapezoid(weight * (at - best) ** 2, at) / np.trapezoid(weight, at)))
