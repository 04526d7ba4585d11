"""The fit from recordings to parameters with their standard deviations."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from servo_daemon.conditioning.current_moment import unfiltered
from servo_daemon.errors import BadInputError, NumericalError
from servo_daemon.identification.output_error.discrepancy.misfit import with_misfit
from servo_daemon.identification.output_error.fitted import FitOptions, OutputErrorFit
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
from servo_daemon.identification.output_error.search import fitted_torque_size, from_other_starts_on, search
from servo_daemon.identification.output_error.solver.solver import solve
from servo_daemon.identification.output_error.starts import (
    Start,
    coordinates,
    sizes,
    starting_points,
    torque_size,
)
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.parameters import Parameter
from servo_daemon.plant.effects import effects_by_name, parameter_table
from servo_daemon.samples import F64


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
    solution, start = search(problem, starts, options)
    solution = from_other_starts_on(problem, solution, recordings, options)
    first = solve(problem, problem.start(coordinates(start, problem)), robust=False, max_iterations=0)
    assert first is not None  # it was searched from
    size = fitted_torque_size(problem, recordings, solution)
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
        effects: tuple[str, ...],
        values: Mapping[str, float],
        held: Collection[str] = (),
        *,
        late_s: float = 0.0,
        rows_late: int = 0,
        mean_current: bool = False,
    ) -> OutputErrorFit | None:
        table = parameter_table()
        within = {n: float(np.clip(values[n], table[n].lower, table[n].upper)) for n in held}
        fixed = {**within, **options.fixed}
        with suppress(NumericalError):
            begun = replace(
                options, nominal={**values, **fixed}, fixed=fixed, thorough=False, noise_model="none", misfit=False
            )
            right = [_put_right(r, late_s, rows_late, mean_current=mean_current) for r in recordings]
            return fit_output_error(right, effects, begun)
        return None

    problem = fit.problem
    at_end = problem.coordinates(fit.solution.point.unknowns, 0)
    here = Start(fit.start, natural_values(problem.plant.parameters, at_end))
    return with_misfit(fit, _coordinate_scale(problem, recordings, here), again)


def _put_right(recording: Recording, late_s: float, rows_late: int, *, mean_current: bool) -> Recording:
    """With the current that flowed, where it is shown so late, or as the mean that it is, and the voltage from so many
    rows below, or above."""
    block = replace(recording.block, current_mean=recording.block.current_mean or mean_current)
    if late_s and block.current_A is not None:
        block = replace(block, current_A=unfiltered(block.time_s, block.current_A, late_s))
    if rows_late and block.voltage_V is not None:
        v = block.voltage_V
        block = replace(block, voltage_V=v[np.clip(np.arange(len(v)) + rows_late, 0, len(v) - 1)])
    return replace(recording, block=block)


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
