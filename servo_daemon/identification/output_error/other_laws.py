"""B, R and L where the model lacks something: what follows another law leaves nearly their trace.

A motor with dry friction turns as one with more viscous friction, and B takes all of it; the drop of brushes passes for
more resistance in R, the lag of a filtered speed for L, a weight for more of all of them. They come out several times
too large, and little is left of the data that would say so. So where something is left, models with the other laws are
fitted, and as far as the best of them moves the parameters, these are unknown.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.lag_like import Refit, halved_lag, moved_to, values_of
from servo_daemon.identification.output_error.noise.noise import WORTH
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
#: Effects that are seen in one channel only.
_NEEDS = {"brush_voltage_drop": "current_A", "speed_filter": "velocity_rad_s"}


def by_other_laws(fit: OutputErrorFit, again: Refit, *, dry: bool = False) -> F64 | None:
    """By how much the coordinates of the free parameters may be off, in one direction, where something follows another
    law: 1 σ, shape (k,). None: the model has these laws, or they explain no more.

    Args:
        dry: dry friction alone is asked for.
    """
    problem, held = fit.problem, _held(fit)
    found = [
        again((*problem.plant.effects, name), begin, held)
        for name in _missing(fit)
        if not dry or name == "coulomb_friction"
        for begin in _begins(fit, name, held)
    ]
    best = min((f for f in found if f is not None), key=lambda f: f.solution.point.value, default=None)
    if best is None or best.solution.point.value > fit.plain.point.value - WORTH:
        return None
    return moved_to(best, fit)


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


def _held(fit: OutputErrorFit) -> frozenset[str]:
    """One parameter of each direction without a trace: what moves along it says nothing. Along a direction of which the
    model shows too little, another law may show enough."""
    held: set[str] = set()
    for direction in (d for d in fit.null_directions if d.exact):
        open_ones = {n: abs(share) for n, share in direction.components.items() if n not in {"B", *held}}
        if open_ones:
            held.add(max(open_ones, key=lambda n: open_ones[n]))
    return frozenset(held)
