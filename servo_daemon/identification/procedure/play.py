"""A fit of a load behind a gap, with the load searched for in every run: see `estimators.short_runs`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.identification.output_error.problem.setup import acceleration_size, make_problem
from servo_daemon.identification.output_error.solver.solver import solve
from servo_daemon.identification.short_runs import begun_short_runs, by_short_runs, can_be_fitted, with_found_states
from servo_daemon.kalman.gaussian import natural_values, to_coordinate

#: Length of the free runs, s, where none is asked for.
_RUNS_S = 0.4
#: Where nothing is known of it: a load of this share of all inertia, on teeth that swing like this, so damped, behind a
#: gap that the motor's acceleration crosses in this time.
_SHARE, _TEETH_RAD_S, _DAMPING, _CROSSING_S = 0.3, 300.0, 0.15, 8e-3
_ITERATIONS = 25


def fit_with_play(
    recordings: Sequence[Recording], effects: tuple[str, ...], options: FitOptions
) -> OutputErrorFit | None:
    """The fit of a model with `backlash`; None where the load cannot be searched for (several recordings, a given gap,
    other effects with states of their own, an inertia that the data do not show): then free runs decide.

    Raises:
        as `fit_output_error`.
    """
    runs_s = options.segment_s or _RUNS_S
    problem = make_problem(recordings, effects, options.fixed)
    if not can_be_fitted(problem):
        return None
    rigid = fit_output_error(
        recordings, tuple(e for e in effects if e != "backlash"), replace(options, segment_s=runs_s, noise_model="none")
    ).values
    if "J" not in rigid:
        return None
    J_l = _SHARE * rigid["J"]
    k_s = (1.0 - _SHARE) * J_l * _TEETH_RAD_S**2
    guessed = {
        "J": rigid["J"] - J_l,
        "J_l": J_l,
        "k_s": k_s,
        "c_s": 2.0 * _DAMPING * k_s / _TEETH_RAD_S,
        "gap": acceleration_size(recordings[0].block) * _CROSSING_S**2,
    }
    nominal = {p.name: p.nominal for p in problem.plant.parameters}
    known = {name: value for name, value in options.nominal.items() if name not in rigid}
    start = {**nominal, **rigid, **guessed, **known, **options.fixed}
    begin = begun_short_runs(problem, start, rigid)
    if begin is None:
        return None
    runs = with_found_states(make_problem(recordings, effects, options.fixed, segment_s=runs_s), begin)
    unknowns = runs.start({p.name: to_coordinate(p, begin[p.name]) for p in runs.plant.parameters})
    found = solve(runs, unknowns, robust=options.robust, max_iterations=_ITERATIONS, curved=False)
    values = (
        begin if found is None else natural_values(runs.plant.parameters, runs.coordinates(found.point.unknowns, 0))
    )
    free = replace(options, nominal={**options.nominal, **values}, segment_s=runs_s, noise_model="none", thorough=False)
    return by_short_runs(fit_output_error(recordings, effects, free), recordings, values)
