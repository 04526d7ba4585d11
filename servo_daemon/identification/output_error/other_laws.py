"""B and R where the model lacks something: losses that grow otherwise with speed or current leave nearly their trace.

A motor with dry friction turns as one with more viscous friction, and B takes all of it; the drop of brushes passes for
more resistance in R. They come out several times too large, and little is left of the data that would say so. So where
something is left, models with losses of other laws are fitted, and as far as the best of them moves the parameters,
these are unknown.
"""

from __future__ import annotations

from collections.abc import Iterator

from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.lag_like import Refit, moved_to
from servo_daemon.identification.output_error.noise.noise import WORTH
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import F64

#: Losses that do not grow with speed or current, and one that grows with the square of the speed: the parameter that
#: takes them, and the one that a model with any loss of that law has.
_OTHERS = (("coulomb_friction", "B", "Tc"), ("quadratic_drag", "B", "c2"), ("brush_voltage_drop", "R", "Vb"))


def by_other_laws(fit: OutputErrorFit, again: Refit) -> F64 | None:
    """By how much the coordinates of the free parameters may be off, in one direction, where some of the losses follow
    another law: 1 σ, shape (k,). None: the model has these laws, or they explain no more."""
    problem = fit.problem
    values = natural_values(problem.plant.parameters, problem.coordinates(fit.solution.point.unknowns, 0))
    held = _held(fit)
    found = [again((*problem.plant.effects, name), values, held) for name in _missing(fit)]
    best = min((f for f in found if f is not None), key=lambda f: f.solution.point.value, default=None)
    if best is None or best.solution.point.value > fit.plain.point.value - WORTH:
        return None
    return moved_to(best, fit)


def _missing(fit: OutputErrorFit) -> Iterator[str]:
    """Effects of `_OTHERS` that the model lacks and whose trace a free parameter may have taken. Without a current R is
    seen only together with K, and brushes beside both."""
    problem, known = fit.problem, effects_by_name()
    there = {p.name for name in problem.plant.effects for p in known[name].parameters}
    seen = set(problem.free) - ({"R"} if "current_A" not in problem.channels else set())
    for name, takes, parameter in _OTHERS:
        if takes in seen and parameter not in there:
            yield name


def _held(fit: OutputErrorFit) -> frozenset[str]:
    """One parameter of each null direction: what moves along it says nothing."""
    held: set[str] = set()
    for direction in fit.null_directions:
        open_ones = {n: abs(share) for n, share in direction.components.items() if n not in {"B", *held}}
        if open_ones:
            held.add(max(open_ones, key=lambda n: open_ones[n]))
    return frozenset(held)
