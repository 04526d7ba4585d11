"""From the search's end to parameters: natural units, standard deviations, and what is not determined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error.precision.information import Information, information, log_std
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.solver.solver import Point, Solution, solve
from servo_daemon.kalman.gaussian import from_coordinate
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import F64

Status = Literal["estimated", "undetermined", "fixed"]

#: Viscous friction of this share of the back-EMF's braking K²/R shows what it could do.
_VISIBLE_FRICTION = 0.05
#: Null directions of two points are two where so much of one is not in the others.
_APART = 0.5
#: What a simulation from sample to sample is exact to where friction or brushes switch between two of them: over eight
#: captures R, L, K, J, B and the effect's own were 0.02 .. 0.10 % off together, with 1 σ of the noise 0.03 %.
BETWEEN_SAMPLES = 1e-3
#: A logarithm so near to a bound is at it.
_AT_BOUND = 1e-3
#: Units of what means nothing without a size.
_OF_NOTHING = ("rad", "Hz", "s")


@dataclass(frozen=True, slots=True)
class FittedParameter:
    """One parameter of the fit.

    Attributes:
        value: natural units; None where neither data nor a nominal value give one.
        std: 1 σ in the same unit; None where it is not estimated.
        status: "undetermined": the data leave it open, the value is a start value that took part in the fit.
        at_bound: it ended at a physical bound: undetermined, and without a value.
        bound: which one, natural units.
    """

    value: float | None
    std: float | None
    unit: str
    status: Status
    at_bound: bool
    bound: float | None = None


def fitted_parameters(
    problem: Problem,
    solution: Solution,
    info: Information,
    nominal: Mapping[str, float],
    fixed: Mapping[str, float],
) -> tuple[dict[str, FittedParameter], tuple[Mapping[str, FittedParameter], ...]]:
    """All of them, and per recording its own offsets.

    Args:
        nominal, fixed: as given, natural units.
    """
    table = {p.name: p for p in problem.plant.parameters}
    std = np.sqrt(np.maximum(np.diag(info.covariance), 0.0))
    lost, bounded = _lost(problem, info, std), at_bounds(problem, solution)
    if problem.plant.may_stick or "brush_voltage_drop" in problem.plant.effects:
        std = np.hypot(std, [BETWEEN_SAMPLES if table[n].transform == "log" else 0.0 for n in info.names])

    def fitted(column: int) -> FittedParameter:
        p = table[info.names[column]]
        value, sigma = from_coordinate(p, float(solution.point.unknowns[column]), float(std[column]))
        if column in bounded:
            return FittedParameter(None, None, p.unit, "undetermined", True, bounded[column])
        if lost[column]:  # what the data do not say is the nominal value, if there is one
            return FittedParameter(nominal.get(p.name), None, p.unit, "undetermined", False)
        return FittedParameter(value, sigma, p.unit, "estimated", False)

    out: dict[str, FittedParameter] = {}
    offsets: list[dict[str, FittedParameter]] = [{} for _ in range(problem.recordings if problem.local else 0)]
    for column, name in enumerate(info.names):
        if column < problem.n_shared:
            out[name] = fitted(column)
        else:
            offsets[(column - problem.n_shared) // len(problem.local)][name] = fitted(column)
    for name, coordinate in problem.given.items():
        value = fixed.get(name, from_coordinate(table[name], coordinate, 0.0)[0])  # not by way of its logarithm
        out[name] = FittedParameter(value, None, table[name].unit, "fixed", False)
    for name in problem.local:
        out[name] = _mean([o[name] for o in offsets])
    return {n: out[n] for n in problem.plant.parameter_names}, tuple(offsets)


def at_bounds(problem: Problem, solution: Solution) -> dict[int, float]:
    """Columns of parameters that ended at a physical bound, whether they press against it or nothing moves them away:
    the bound, natural units. (A phase has none: a turn further it is the same.)"""
    table = {p.name: p for p in problem.plant.parameters}
    low, high = problem.bounds
    out = {}
    for k, name in enumerate(problem.parameter_of_column):
        p, at = table[name], float(solution.point.unknowns[k])
        if p.transform == "log":
            ends = [b for b, end in ((p.lower, low[k]), (p.upper, high[k])) if abs(at - end) < _AT_BOUND]
        else:
            near = p.lower if at - p.lower < p.upper - at else p.upper
            ends = [near] if k in solution.at_bound and p.unit != "rad" else []
        if ends:
            out[k] = ends[0]
    return out


def seen_with_friction(problem: Problem, point: Point, scale: F64) -> Information | None:
    """What is known if viscous friction were a visible share of the braking K²/R; None where it is, or cannot hide.

    A logarithm near its lower bound hides what its parameter could do: with B almost 0, K/(B R + K²) seems to be 1/K.
    """
    names = problem.parameter_of_column
    if problem.plant.drive != "voltage" or "current_A" in problem.channels or "B" not in problem.free:
        return None
    values = {**problem.given, **dict(zip(names, point.unknowns, strict=False))}
    visible = np.log(_VISIBLE_FRICTION) + 2 * values["K"] - values["R"]
    if values["B"] >= visible:
        return None
    moved = point.unknowns.copy()
    moved[names.index("B")] = visible
    there = solve(problem, moved, robust=False, max_iterations=0)
    return None if there is None else information(problem, there.point, scale)


def with_nulls_of(info: Information, other: Information) -> Information:
    """What is known, with what another point of the same problem leaves without a trace; of two null directions that
    are nearly one, the other point's."""
    own = info.exact - info.exact @ other.exact.T @ other.exact
    apart = own[np.linalg.norm(own, axis=1) > _APART]
    undetermined = info.undetermined | other.undetermined
    return replace(info, undetermined=undetermined, exact=np.vstack([other.exact, apart]))


def _lost(problem: Problem, info: Information, std: F64) -> NDArray[np.bool_]:
    """Which columns are not determined: by the information; where the residual's colour has widened 1 σ beyond a factor
    of e; and phase, frequency or instant of an effect whose size may as well be zero."""
    table = {p.name: p for p in problem.plant.parameters}
    logs = np.array([table[n].transform == "log" for n in info.names], dtype=bool)
    out = info.undetermined | (logs & (std > 1.0))
    known = effects_by_name()
    for effect in problem.plant.effects:
        own = [p.name for p in known[effect].parameters]
        size, rest = own[:1], own[1:]
        if any(logs[k] and std[k] > 1.0 and log_std(info, n) > 1.0 for k, n in enumerate(info.names) if n in size):
            out |= np.array([n in rest and table[n].unit in _OF_NOTHING for n in info.names], dtype=bool)
    return np.asarray(out)


def _mean(each: Sequence[FittedParameter]) -> FittedParameter:
    """One figure for an offset that every recording has for itself: weighted mean and its std."""
    known = [(e.value, e.std) for e in each if e.value is not None and e.std]
    if not known:
        return replace(each[0], std=None)
    weight = np.array([1.0 / s**2 for _, s in known if s])
    values = np.array([v for v, _ in known])
    return replace(each[0], value=float(weight @ values / weight.sum()), std=float(1.0 / np.sqrt(weight.sum())))


def correlation_of(info: Information, n_shared: int) -> dict[str, dict[str, float]]:
    known = [k for k in range(n_shared) if not info.undetermined[k]]
    std = np.sqrt(np.maximum(np.diag(info.covariance), 1e-300))
    C = info.covariance / np.outer(std, std)
    return {info.names[a]: {info.names[b]: float(np.clip(C[a, b], -1, 1)) for b in known} for a in known}
