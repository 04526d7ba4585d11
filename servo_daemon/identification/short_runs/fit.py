"""From start values, right or not, to the parameters of a motor with a load behind a gap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.short_runs.gap import FAR, NEAR, NEAREST, with_other_gap
from servo_daemon.identification.short_runs.informative import RunSource
from servo_daemon.identification.short_runs.runs import FEW_SAMPLES, MOST_SAMPLES, SHORT, can_be_fitted
from servo_daemon.identification.short_runs.search import ShortRunFit, search, within
from servo_daemon.kalman.gaussian import coordinates_of
from servo_daemon.samples import F64

#: Loads as shares of all inertia, on teeth that swing like this, so damped, that a search begins at, and samples that
#: tell which of them is best.
_SHARES, _TEETH_RAD_S, _TEETH_DAMPING, _FEWEST_SAMPLES = (0.15, 0.4), (200.0, 450.0), 0.15, 2_500
#: Searches from start values, and rounds of these and of the last ones.
_TIMES, _BEGINNING_ROUNDS, _ROUNDS = 2, 2, 2
#: No logarithm follows the gap's by more times as much while that is looked for: it does so along no straight line.
_FOLLOWS = 5.0


def begun_short_runs(
    problem: Problem, start: Mapping[str, float], rigid: Mapping[str, float]
) -> dict[str, float] | None:
    """Where a fit is to begin, natural units: from values that may be several times too large or too small. None: the
    model or the data are none for it.

    Args:
        problem: of one recording; its segments are cut up, its free parameters searched for.
        start: of all parameters; loads and teeth of other sizes are tried as well.
        rigid: of the motor that turns with all its load, as fitted.
    """
    if not can_be_fitted(problem):
        return None
    columns, source = _columns(problem), RunSource(problem, {**start, **rigid})
    q = _best_begun(source, coordinates_of(problem.plant.parameters, start), columns)
    for _ in range(_TIMES):  # how long a run is to be hangs on what is searched for
        short = source.in_swings(q, SHORT, FEW_SAMPLES)
        if short is None:
            return None
        q = search(short, q, columns, _BEGINNING_ROUNDS).q
    q, _ = with_other_gap(source, q, FAR)
    short = source.in_swings(q, SHORT, FEW_SAMPLES)
    return None if short is None else search(short, q, _but_the_gap(problem), 1).values


def fit_short_runs(source: RunSource, start: Mapping[str, float]) -> ShortRunFit | None:
    """Fit from values that are about right; None: the model or the data are none for it. See `begun_short_runs`."""
    problem = source.problem
    if not can_be_fitted(problem):
        return None
    gap, columns = problem.plant.parameter_names.index("gap"), _but_the_gap(problem)

    def of_short_runs(q: F64, rounds: int) -> ShortRunFit | None:
        runs = source.in_swings(q, SHORT, MOST_SAMPLES)
        return None if runs is None else search(runs, q, columns, rounds)

    found, gap_std = of_short_runs(coordinates_of(problem.plant.parameters, start), 1), np.inf
    for scan in (NEAR, NEAREST):  # a gap a little wrong bends the teeth, and these the gap
        if found is None:
            return None
        move = np.clip(found.following(gap), -_FOLLOWS, _FOLLOWS) if scan is NEAREST else None
        q, gap_std = with_other_gap(source, found.q, scan, move)
        found = of_short_runs(q, _ROUNDS)
    return None if found is None else found.with_gap(gap, gap_std)


def _columns(problem: Problem) -> tuple[int, ...]:
    """Which of the plant's parameters are free."""
    return tuple(problem.plant.parameter_names.index(n) for n in problem.free)


def _but_the_gap(problem: Problem) -> tuple[int, ...]:
    """The same without the gap: short runs hardly cross it, and a descent moves it by little."""
    names = problem.plant.parameter_names
    return tuple(k for k in _columns(problem) if names[k] != "gap")


def _best_begun(source: RunSource, q: F64, columns: Sequence[int]) -> F64:
    """The best of a few steps from here and from other loads on other teeth."""
    names, rigid_J = source.problem.plant.parameter_names, source.motor["J"]
    runs = source.runs(SHORT * 2 * np.pi / max(_TEETH_RAD_S), _FEWEST_SAMPLES)
    if runs is None:
        return q
    starts = [q]
    for share in _SHARES:
        for omega in _TEETH_RAD_S:
            other = q.copy()
            J, J_l = (1.0 - share) * rigid_J, share * rigid_J
            k_s = J * share * omega**2  # against the reduced inertia
            for name, value in {"J": J, "J_l": J_l, "k_s": k_s, "c_s": 2 * _TEETH_DAMPING * k_s / omega}.items():
                if name in source.problem.free:
                    other[names.index(name)] = np.log(value)
            starts.append(within(runs, other))
    found = [search(runs, s, columns, 1) for s in starts]
    return min(found, key=lambda f: f.value).q
