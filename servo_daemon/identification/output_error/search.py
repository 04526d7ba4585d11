"""Searches from several starts: which are tried, and which end is gone on with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from servo_daemon.errors import NumericalError
from servo_daemon.identification.output_error.diverged_segments import ENOUGH, begun_again
from servo_daemon.identification.output_error.fitted import FitOptions
from servo_daemon.identification.output_error.multi_start import from_nearby, from_other_starts, is_to_be_searched
from servo_daemon.identification.output_error.noise.residual import residual_tests
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.identification.output_error.solver.solver import Point, Solution, solve
from servo_daemon.identification.output_error.starts import BY_SIZES, BY_WINDOWS, Start, coordinates, torque_size
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.regression.held_shaft import STILL

#: Guessed starts that are searched from, besides nominal values and regression.
_SEARCHED = 2
#: Another start must lower V (2 log-likelihood) by more than this to win.
_BETTER = 1.0
#: Two ends whose V differ by less are one.
_SAME = 0.2
#: Iterations of the first search, and of those that follow only to see whether there is a better minimum.
_FIRST_SEARCH, _OTHER_SEARCHES = 60, 25


def search(problem: Problem, starts: Sequence[Start], options: FitOptions) -> tuple[Solution, Start]:
    """The best end of the searches: all but the guesses from sizes are tried, and of these the most promising.

    It is over when an end explains the data to their noise, or when another search comes to the same place.
    """
    windows, guesses = ([s for s in starts if kind in s.source] for kind in (BY_WINDOWS, BY_SIZES))
    chosen = [s for s in starts if s not in windows and s not in guesses]
    chosen += _most_promising(problem, guesses, _SEARCHED) + _most_promising(problem, windows, 1)
    best: tuple[Solution, Start] | None = None
    enough = 0.0 if options.thorough else ENOUGH * float(problem.counts.sum())
    idle = bool((problem.spread <= STILL).all())  # nothing moves: nothing to search for
    for start in chosen:
        been = None if best is None else best[0].point
        found = solve(
            problem,
            problem.start(coordinates(start, problem)),
            robust=options.robust,
            max_iterations=0 if idle else _FIRST_SEARCH if been is None else _OTHER_SEARCHES,
            give_up=None if been is None else _same_place(been),
            enough=enough,
            curved=options.thorough,
        )
        if found is None:
            continue
        if been is not None and _same_place(been)(found.point):
            break
        if best is None or found.point.value < best[0].point.value - _BETTER:
            best = found, start
            if idle or _is_white(problem, found):
                break
    if best is None:
        raise NumericalError("the motor cannot be simulated over these data from any start: values out of range?")
    if (
        not idle
        and not best[0].converged
        and options.thorough
        and (further := solve(problem, best[0].point.unknowns, robust=options.robust)) is not None
    ):
        best = _in_a_row(best[0], further), best[1]
    return _with_diverged_segments(problem, best[0], options, enough), best[1]


def from_other_starts_on(
    problem: Problem, found: Solution, recordings: Sequence[Recording], options: FitOptions
) -> Solution:
    """The end of a search, gone on with from the best instant or frequency of all that were tried."""
    if not is_to_be_searched(problem) or _is_white(problem, found):
        return found
    if not options.thorough:
        nearby = from_nearby(problem, found, robust=options.robust) if options.segment_s is not None else None
        return _gone_on(found, nearby)
    seconds = max(float(r.block.time_s[-1] - r.block.time_s[0]) for r in recordings)
    torque_Nm = fitted_torque_size(problem, recordings, found)
    begun = from_other_starts(problem, found, seconds, torque_Nm, robust=options.robust)
    further = None if begun is None else solve(problem, begun.point.unknowns, robust=options.robust)
    return _gone_on(found, further)


def _with_diverged_segments(problem: Problem, found: Solution, options: FitOptions, enough: float) -> Solution:
    """The end of a search over pieces of a recording, gone on with where some of these had begun in the wrong place."""
    again = begun_again(problem, found) if options.segment_s is not None else None
    if again is None:
        return found
    curved = options.thorough
    further = solve(problem, again, robust=options.robust, max_iterations=_OTHER_SEARCHES, enough=enough, curved=curved)
    return _gone_on(found, further)


def _is_white(problem: Problem, found: Solution) -> bool:
    return all(test.white for test in residual_tests(problem, found.point).values())


def _gone_on(found: Solution, further: Solution | None) -> Solution:
    """What was found, gone on with where that is better."""
    better = further is not None and further.point.value < found.point.value - _BETTER
    return _in_a_row(found, further) if further is not None and better else found


def _in_a_row(first: Solution, then: Solution) -> Solution:
    """One search that went on where it had been stopped."""
    done = first.iterations[-1]
    more = tuple(
        replace(i, number=done.number + i.number, evaluations=done.evaluations + i.evaluations)
        for i in then.iterations[1:]
    )
    return replace(then, iterations=(*first.iterations, *more))


def _most_promising(problem: Problem, guesses: Sequence[Start], number: int) -> list[Start]:
    ends = [solve(problem, problem.start(coordinates(g, problem)), robust=False, max_iterations=0) for g in guesses]
    ranked = sorted((s.point.value, k) for k, s in enumerate(ends) if s is not None)
    return [guesses[k] for _, k in ranked[:number]]


def _same_place(been: Point) -> Callable[[Point], bool]:
    """Whether a search has come to where another has ended: nothing would be won by going on."""

    def same(point: Point) -> bool:
        return abs(point.value - been.value) < max(_SAME, 1e-8 * abs(been.value))

    return same


def fitted_torque_size(problem: Problem, recordings: Sequence[Recording], solution: Solution) -> float:
    """N·m, what the motor exerts in its longest recording, as fitted."""
    values = natural_values(problem.plant.parameters, problem.coordinates(solution.point.unknowns, 0))
    return torque_size(values, max((r.block for r in recordings), key=len), problem.plant.drive)
