"""The fit from recordings to parameters with their standard deviations."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from servo_daemon.errors import BadInputError, NumericalError
from servo_daemon.identification.output_error.diverged_segments import begun_again
from servo_daemon.identification.output_error.fitted import FitOptions, OutputErrorFit
from servo_daemon.identification.output_error.misfit import with_misfit
from servo_daemon.identification.output_error.multi_start import from_nearby, from_other_starts, is_to_be_searched
from servo_daemon.identification.output_error.noise.residual import residual_tests
from servo_daemon.identification.output_error.outcome import conclude
from servo_daemon.identification.output_error.precision.combinations import determined_combinations, voltage_answer
from servo_daemon.identification.output_error.precision.information import information
from servo_daemon.identification.output_error.precision.input_error import SHIFTED, with_input_error
from servo_daemon.identification.output_error.precision.parameters import (
    at_bounds,
    correlation_of,
    fitted_parameters,
    seen_with_friction,
    with_nulls_of,
)
from servo_daemon.identification.output_error.precision.voltage_noise import with_voltage_noise
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.setup import (
    Recording,
    carrying,
    choose_signals,
    common_channels,
    current_size,
    make_problem,
    without_dead_current,
)
from servo_daemon.identification.output_error.problem.still import STILL
from servo_daemon.identification.output_error.solver.solver import Point, Solution, solve
from servo_daemon.identification.output_error.starts import (
    BY_SIZES,
    BY_WINDOWS,
    Start,
    coordinates,
    sizes,
    starting_points,
    torque_size,
)
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.parameters import Parameter
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import F64

#: Guessed starts that are searched from, besides nominal values and regression.
_SEARCHED = 2
#: Another start must lower V (2 log-likelihood) by more than this to win.
_BETTER = 1.0
#: Two ends whose V differ by less are one.
_SAME = 0.2
#: Iterations of the first search, and of those that follow only to see whether there is a better minimum.
_FIRST_SEARCH, _OTHER_SEARCHES = 60, 25
#: V per value that an iteration must win where a rough end will do: half of it is the change of the RMS.
_ENOUGH = 1e-4


def fit_output_error(
    recordings: Sequence[Recording], effects: tuple[str, ...] = (), options: FitOptions | None = None
) -> OutputErrorFit:
    """Fit a motor with these effects to the recordings.

    Raises:
        BadInputError: no usable signals, too few samples, an impossible fixed value.
        ConfigError: an unknown effect.
        NumericalError: no start could be simulated.
    """
    options = options or FitOptions()
    began = time.perf_counter()
    recordings = without_dead_current(recordings)
    choices = _choices(effects, {**options.nominal, **options.fixed}, choose_signals(common_channels(recordings))[1])
    options = replace(options, fixed={**choices, **options.fixed})
    problem = make_problem(recordings, effects, options.fixed, segment_s=options.segment_s)
    if not options.thorough:
        problem = carrying(problem, recordings)
    points = starting_points(recordings, problem, {**options.nominal, **options.fixed})
    starts = list(points) if options.thorough else [next(points)]
    scale = _coordinate_scale(problem, recordings, starts[0])
    solution, start = _search(problem, starts, options)
    solution = _from_other_starts_on(problem, solution, recordings, options)
    first = solve(problem, problem.start(coordinates(start, problem)), robust=False, max_iterations=0)
    assert first is not None  # it was searched from
    size = _torque_size(problem, recordings, solution)
    outcome = conclude(problem, solution, scale, options.noise_model, size, options.deviance_below)
    plain, solution, after = solution, outcome.solution, outcome.information
    if problem.plant.drive != "voltage":
        shifted = make_problem(recordings, effects, options.fixed, segment_s=options.segment_s, input_share=SHIFTED)
        shifted = shifted if options.thorough else carrying(shifted, recordings)
        given = {**options.nominal, **options.fixed} if options.holds_voltage else None
        after = with_input_error(after, recordings, (problem, shifted), solution.point, given)
    elif options.thorough:
        after = with_voltage_noise(after, problem, solution.point, outcome.as_weighed(problem))
    at_end = problem.coordinates(solution.point.unknowns, 0)
    answer = voltage_answer(problem.plant, at_end, after, scale)
    with_friction = seen_with_friction(problem, solution.point, scale)
    if with_friction is not None:
        after = with_nulls_of(after, with_friction)
    parameters, offsets = fitted_parameters(problem, solution, after, options.nominal, options.fixed)
    found = OutputErrorFit(
        problem=problem,
        solution=solution,
        parameters=parameters,
        offsets=offsets,
        correlation=correlation_of(after, problem.n_shared),
        before=information(problem, first.point, scale),
        after=after,
        combinations=determined_combinations(problem.plant, at_end, answer, after, scale, at_bounds(problem, solution)),
        answer=answer,
        residual=outcome.residual,
        innovation=outcome.innovation,
        noise=outcome.noise,
        refined=outcome.refined,
        unsettled=outcome.unsettled,
        plain=plain,
        start=start.source,
        seconds=time.perf_counter() - began,
    )
    return published(found, recordings, options) if options.misfit and options.thorough else found


def published(fit: OutputErrorFit, recordings: Sequence[Recording], options: FitOptions) -> OutputErrorFit:
    """The fit as it can be published: see `misfit.py`.

    Args:
        recordings, options: of the fit.
    """

    def again(
        effects: tuple[str, ...], values: Mapping[str, float], held: Collection[str] = ()
    ) -> OutputErrorFit | None:
        table = {p.name: p for p in fit.problem.plant.parameters}
        within = {n: float(np.clip(values[n], table[n].lower, table[n].upper)) for n in held}
        fixed = {**within, **options.fixed}
        with suppress(NumericalError):
            begun = replace(
                options, nominal={**values, **fixed}, fixed=fixed, thorough=False, noise_model="none", misfit=False
            )
            return fit_output_error(recordings, effects, begun)
        return None

    problem = fit.problem
    at_end = problem.coordinates(fit.solution.point.unknowns, 0)
    here = Start(fit.start, natural_values(problem.plant.parameters, at_end))
    return with_misfit(fit, _coordinate_scale(problem, recordings, here), again)


def _choices(effects: Sequence[str], given: Mapping[str, float], measured: Sequence[str]) -> dict[str, float]:
    """Parameters of these effects that are no numbers: as given, else the usual ones, of channels a measured one.

    Raises:
        BadInputError: a channel that is not measured was given.
    """
    known, out = effects_by_name(), dict[str, float]()
    for p in (p for name in effects if name in known for p in known[name].parameters if p.held == "always"):
        channels = [k for k, choice in enumerate(p.choices) if choice in measured]
        usual = p.nominal if not channels or p.nominal in channels else float(channels[0])
        out[p.name] = given.get(p.name, usual)
        if channels and out[p.name] in range(len(p.choices)) and out[p.name] not in channels:
            named = " or ".join(p.choices[k] for k in channels)
            raise BadInputError(f"{p.name} = {p.choices[int(out[p.name])]} is not measured here, but {named}")
    return out


def _search(problem: Problem, starts: Sequence[Start], options: FitOptions) -> tuple[Solution, Start]:
    """The best end of the searches: all but the guesses from sizes are tried, and of these the most promising.

    It is over when an end explains the data to their noise, or when another search comes to the same place.
    """
    windows, guesses = ([s for s in starts if kind in s.source] for kind in (BY_WINDOWS, BY_SIZES))
    chosen = [s for s in starts if s not in windows and s not in guesses]
    chosen += _most_promising(problem, guesses, _SEARCHED) + _most_promising(problem, windows, 1)
    best: tuple[Solution, Start] | None = None
    enough = 0.0 if options.thorough else _ENOUGH * float(problem.counts.sum())
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


def _from_other_starts_on(
    problem: Problem, found: Solution, recordings: Sequence[Recording], options: FitOptions
) -> Solution:
    """The end of a search, gone on with from the best instant or frequency of all that were tried."""
    if not is_to_be_searched(problem) or _is_white(problem, found):
        return found
    if not options.thorough:
        nearby = from_nearby(problem, found, robust=options.robust) if options.segment_s is not None else None
        return _gone_on(found, nearby)
    seconds = max(float(r.block.time_s[-1] - r.block.time_s[0]) for r in recordings)
    torque_Nm = _torque_size(problem, recordings, found)
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


def _coordinate_scale(problem: Problem, recordings: Sequence[Recording], start: Start) -> F64:
    """One unit of each coordinate: a factor of e for a logarithm, the typical signal for an offset."""
    block = max((r.block for r in recordings), key=len)
    table = {p.name: p for p in problem.plant.parameters}
    voltage = float(np.max(np.abs(block.voltage_V))) if block.voltage_V is not None else 1.0
    scales = sizes(start.values, block, problem.plant)
    units = {
        "N·m": torque_size(start.values, block, problem.plant.drive),
        "A": current_size(block),
        "V": voltage,
    }

    def unit(p: Parameter) -> float:
        if p.transform == "log":
            return 1.0
        size = units.get(p.unit, 1.0) if p.scale is None else p.scale.product(scales)
        return max(size, 1e-12)

    return np.array([unit(table[name]) for name in problem.parameter_of_column])


def _torque_size(problem: Problem, recordings: Sequence[Recording], solution: Solution) -> float:
    """N·m, what the motor exerts in its longest recording, as fitted."""
    values = natural_values(problem.plant.parameters, problem.coordinates(solution.point.unknowns, 0))
    return torque_size(values, max((r.block for r in recordings), key=len), problem.plant.drive)
