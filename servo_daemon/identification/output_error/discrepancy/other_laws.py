"""B, R and L where the model lacks something: what follows another law leaves nearly their trace.

A motor with dry friction turns as one with more viscous friction, and B takes all of it; the drop of brushes passes for
more resistance in R, the lag of a filtered speed for L, a weight for more of all of them. They come out several times
too large, and little is left of the data that would say so. So where something is left, models with the other laws are
fitted, and as far as the best of them moves the parameters, these are unknown.

A motion that never turns back leaves nothing of it: all that dry friction does there, a viscous one does as well.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from servo_daemon.identification.output_error.discrepancy.lag_like import (
    SHARE,
    Refit,
    halved_lag,
    moved_to,
    values_of,
)
from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.noise.noise import WORTH
from servo_daemon.identification.output_error.problem.rollout import INPUT, STEP
from servo_daemon.numerics import least_squares, squares_left
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import F64

#: Losses that do not grow with speed or current, one that grows with the square of the speed, a load that pulls one way
#: and the filter of a speed's sensor: the parameter that takes them, and the one that a model with any effect of that
#: kind has.
_OTHERS = (
    ("coulomb_friction", "B", "Tc"),
    ("quadratic_drag", "B", "c2"),
    ("constant_load_torque", "B", "TL"),
    ("brush_voltage_drop", "R", "Vb"),
    ("speed_filter", "L", "t_f"),
)
#: A motion goes one way if less than this share of it goes back, told by so many parts of a segment (chosen).
_BACK, _PARTS, _FEWEST = 0.01, 50, 4
#: A constant torque is told apart if this share of it follows neither speed nor acceleration: steps of five motors from
#: rest leave 0.0001 to 0.011, pieces of 0.3 s of multisines and pick and place 0.025 to 0.47.
_APART = 0.02
#: The current's answer to the step of the voltage's own row, over its standard error, and as a share of what a whole
#: row makes; rows before it whose steps and residuals tell what a misfit would have left here.
_SIGMA, _LEAST, _PAST = 5.0, 0.1, 2
#: Effects that are seen in one channel only.
_NEEDS = {"brush_voltage_drop": "current_A", "speed_filter": "velocity_rad_s"}


def with_another_law(fit: OutputErrorFit, again: Refit, *, dry: bool = False) -> OutputErrorFit | None:
    """The likeliest of the models with one law more: as far as it moves the parameters, these are unknown, 1 σ. None:
    the model has these laws, or they explain no more.

    Args:
        dry: dry friction alone is asked for.
    """
    names = [name for name in _missing(fit) if not dry or name == "coulomb_friction"]
    best = _best(fit, again, names)
    return None if best is None or best.solution.point.value > fit.plain.point.value - WORTH else best


def by_unheld_voltage(fit: OutputErrorFit, again: Refit) -> F64 | None:
    """By how much the coordinates of the free parameters may be off, in one direction, where the voltage's steps are
    between its samples, as of a supply switched by hand before a shaft that is held or not measured: 1 σ, shape (k,).
    None: the current does not answer before its voltage. (One that was put right for a filter does.)

    No model makes a current that answers a voltage to come. As far as one does, the voltage's steps come up to a row
    before they are written, each by a share that nothing tells: the truth is between the fit and that to a voltage one
    row earlier.
    """
    problem = fit.problem
    turns = len(problem.channels) > 1 and any(s.recording not in problem.blocked for s in problem.segments)
    if turns or problem.plant.drive != "voltage" or "current_A" not in problem.channels or "L" not in problem.free:
        return None
    if not _answers_before(fit):
        return None
    other = again(problem.plant.effects, values_of(fit), rows_late=1)
    return None if other is None else SHARE * moved_to(other, fit)


def by_friction_one_way(fit: OutputErrorFit, again: Refit) -> F64 | None:
    """By how much the coordinates of the free parameters may be off, in one direction, where the
    motion never turns back: dry friction may be half of all, whether or not that explains more. None: it turns."""
    if not friction_goes_one_way(fit):
        return None
    values = values_of(fit)
    other = again(
        (*fit.problem.plant.effects, "coulomb_friction"),
        {**values, "B": values["B"] / 2.0, "Tc": values["B"] / 2.0 * _usual_speed(fit)},
        held_of(fit),
    )
    if other is None:
        return None
    winding = np.array([name == "L" for name in fit.problem.parameter_of_column], dtype=bool)  # friction moves none
    return np.where(winding, 0.0, moved_to(other, fit))


def _answers_before(fit: OutputErrorFit) -> bool:
    """Whether what is left of the current goes with the step of the voltage in its own row, beside the steps and what
    was left in the rows before. (A controller's voltage follows what the current's noise was, too, but against it.)"""
    problem, k, values = fit.problem, fit.problem.channels.index("current_A"), values_of(fit)
    tables = [np.zeros((0, 2 + 2 * _PAST))]
    for segment, left in zip(problem.segments, fit.plain.point.linearisation.residuals, strict=True):
        step, rest, valid = np.diff(segment.rows[:, INPUT]), left[1:, k], segment.valid[1:, k]
        n = len(rest) - _PAST
        if n > 0:
            shifted = [column[_PAST - by : _PAST - by + n] for by in range(1, _PAST + 1) for column in (step, rest)]
            now = np.column_stack([rest[_PAST:], step[_PAST:], *shifted])
            tables.append(now[np.all([valid[by : by + n] for by in range(_PAST + 1)], axis=0)])
    table = np.vstack(tables)
    if len(table) <= table.shape[1]:
        return False
    (answer, *_), rank = least_squares(table[:, 1:], table[:, 0])
    if rank < table.shape[1] - 1:
        return False
    without = squares_left(table[:, 2:], table[:, 0])
    gained = without - squares_left(table[:, 1:], table[:, 0])
    whole = -np.expm1(-values["R"] * problem.sample_period_s / values["L"]) / values["R"]
    return bool(answer > _LEAST * whole and gained * len(table) > _SIGMA**2 * without)


def friction_goes_one_way(fit: OutputErrorFit) -> bool:
    """Whether dry friction, which the model lacks, would pass for B because the motion never turns back and tells it
    from no other torque, and nothing is left of the data that would say so. (Where something is, `with_another_law`
    asks.)"""
    return fit.white and "coulomb_friction" in _missing(fit) and goes_one_way(fit)


def goes_one_way(fit: OutputErrorFit) -> bool:
    """Whether the shaft turns, next to never back, and so that a constant torque passes for one that follows speed and
    acceleration."""
    parts = _parts(fit)
    way = parts[:, 0] * parts[:, 2]
    forth, back = float(np.sum(way[way > 0.0])), -float(np.sum(way[way < 0.0]))
    if min(forth, back) >= _BACK * max(forth, back):
        return False
    moving = parts[np.abs(parts[:, 0]) > _BACK * np.max(np.abs(parts[:, 0]))]
    constant = np.sqrt(moving[:, 2])
    return squares_left(moving[:, :2] * constant[:, None], constant) < _APART * float(constant @ constant)


def _parts(fit: OutputErrorFit) -> F64:
    """Speed, rad/s, acceleration, rad/s², and length, s, of parts of the motion as the model has it, shape (parts, 3);
    none where no motion is measured."""
    problem = fit.problem
    name = next((n for n in ("position_rad", "velocity_rad_s") if n in problem.channels), None)
    if name is None:
        return np.zeros((0, 3))
    k = problem.channels.index(name)
    out = [np.zeros((0, 3))]
    for s, left in zip(problem.segments, fit.solution.point.linearisation.residuals, strict=True):
        if s.recording not in problem.blocked and np.count_nonzero(s.valid[:, k]) > _FEWEST:
            valid = s.valid[:, k]
            time_s, shown = np.cumsum(s.rows[:, STEP])[valid], (s.measured[:, k] - left[:, k])[valid]
            at = np.unique(np.linspace(0, len(shown) - 1, _PARTS + 1).astype(int))
            out.append(_motion(time_s[at], shown[at], position=name == "position_rad"))
    return np.vstack(out)


def _motion(time_s: F64, shown: F64, *, position: bool) -> F64:
    """Speed, acceleration and length of the parts between these times, shape (parts, 3)."""
    if position:
        time_s, shown = 0.5 * (time_s[1:] + time_s[:-1]), np.diff(shown) / np.diff(time_s)
    step_s = np.diff(time_s)
    return np.column_stack([0.5 * (shown[1:] + shown[:-1]), np.diff(shown) / step_s, step_s])


def _usual_speed(fit: OutputErrorFit) -> float:
    """Mean speed over all, rad/s."""
    parts = _parts(fit)
    return abs(float(parts[:, 0] @ parts[:, 2])) / max(float(np.sum(parts[:, 2])), 1e-9)


def _best(fit: OutputErrorFit, again: Refit, names: Collection[str]) -> OutputErrorFit | None:
    """The likeliest of the models with one of these laws more."""
    held = held_of(fit)
    effects = fit.problem.plant.effects
    found = [again((*effects, name), begin, held) for name in names for begin in _begins(fit, name, held)]
    return min((f for f in found if f is not None), key=lambda f: f.solution.point.value, default=None)


def _begins(fit: OutputErrorFit, name: str, held: Collection[str]) -> Iterator[Mapping[str, float]]:
    """Where a model with one law more begins: where the fit has ended and, if that shows too little of some parameters,
    without these, which may have gone anywhere."""
    values = values_of(fit)
    yield halved_lag(values, "t_f") if name == "speed_filter" else values
    if any(not d.exact for d in fit.null_directions):
        yield {n: v for n, v in values.items() if n in held or fit.parameters[n].value is not None}


def _missing(fit: OutputErrorFit) -> Iterator[str]:
    """Effects of `_OTHERS` that the model lacks and whose trace a free parameter may have taken."""
    problem, known = fit.problem, effects_by_name()
    there = {p.name for name in problem.plant.effects for p in known[name].parameters}
    for name, takes, parameter in _OTHERS:
        channel = _NEEDS.get(name)
        if takes in problem.free and parameter not in there and (channel is None or channel in problem.channels):
            yield name


def held_of(fit: OutputErrorFit) -> frozenset[str]:
    """One parameter of each direction without a trace: what moves along it says nothing. Along a direction of which the
    model shows too little, another law may show enough."""
    held: set[str] = set()
    for direction in (d for d in fit.null_directions if d.exact):
        open_ones = {n: abs(share) for n, share in direction.components.items() if n not in {"B", *held}}
        if open_ones:
            held.add(max(open_ones, key=lambda n: open_ones[n]))
    return frozenset(held)
