"""L without a current: what else is as slow leaves the same trace.

The speed answers the voltage by g/((1 + s τ₁)(1 + s τ₂)). Where both poles are real the faster one may be the
winding's, or all of it that of the drive's output stage or of a filter in the speed's sensor, with a winding that is as
good as none; a delay of either differs from these only beyond 1/τ₂. So L lies anywhere from zero to what was fitted,
and J, which makes τ₁ + τ₂ with it, between what was fitted and τ₁/(τ₁ + τ₂) of that. A lag that the model has changes
nothing of this: lags in a row may change places, and one of them takes what L loses. A pair of complex poles no lag
makes, but beside a lag it is fitted as another pair: then the model with a lag tells by how much."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Protocol

import numpy as np

from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.plant.contribution import contribution
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import F64

#: The effects that L may be; and the lags that stand for all of them, the first that the model lacks.
LAGS = {name: effect.late for name, effect in effects_by_name().items() if effect.late}
_LAGS = ("drive_lag", "speed_filter")
#: Of a share between zero and one that nothing is known of, root of the mean square.
SHARE = 1.0 / np.sqrt(3.0)
#: 2 log-likelihood by which two values differ, 3 σ squared.
_TOLD = 9.0
#: No logarithm is moved by more.
_AT_MOST = 3.0


class Refit(Protocol):
    """Fits another model to the same recordings."""

    def __call__(
        self,
        effects: tuple[str, ...],
        values: Mapping[str, float],
        held: Collection[str] = (),
        /,
        *,
        late_s: float = 0.0,
        rows_late: int = 0,
        mean_current: bool = False,
    ) -> OutputErrorFit | None:
        """The model with these effects, from these natural values, of which some are held, and with a current that is
        so late, a voltage that is rows late, put right, a current that is its mean over the row before; None: it cannot
        be simulated."""


def leaves_the_trace_of_l(problem: Problem) -> bool:
    """Whether a lag of something else would pass for L here."""
    return problem.plant.drive == "voltage" and "current_A" not in problem.channels and "L" in problem.free


def equivalents(problem: Problem) -> dict[str, tuple[str, ...]]:
    """By parameter, the effects whose trace it may be."""
    if not leaves_the_trace_of_l(problem):
        return {}
    seen = "velocity_rad_s" in problem.channels
    return {"L": tuple(n for n in LAGS if seen or not contribution(n).touches("velocity_rad_s"))}


def by_other_lags(fit: OutputErrorFit, again: Refit) -> F64 | None:
    """By how much the coordinates of the free parameters may be off, in one direction, where some of the lag is not the
    winding's: 1 σ, shape (k,). None: they are not."""
    problem = fit.problem
    if not leaves_the_trace_of_l(problem):
        return None
    values = values_of(fit)
    names, column = problem.parameter_of_column, np.zeros(len(problem.parameter_of_column))
    poles = _poles(values)
    if poles is not None:
        fast, slow = poles
        moves = {"L": 1.0, "J": fast / (fast + slow)}
        moves |= {t: -min(fast / values[t], _AT_MOST) for name in problem.plant.effects if (t := LAGS.get(name))}
        for name in set(names) & set(moves):
            column[names.index(name)] = SHARE * moves[name]
        return column
    lag = next((name for name in _LAGS if name not in problem.plant.effects), None)
    other = None if lag is None else again((*problem.plant.effects, lag), halved_lag(values, str(LAGS[lag])))
    return None if other is None else moved_to(other, fit)


def with_more_inductance(fit: OutputErrorFit, again: Refit) -> OutputErrorFit | None:
    """A motor whose winding is as slow as all of it seems, where the data do not tell it from one with next to no L:
    beside that the derivative by L's logarithm is none, and shows nothing of what L could do. None: they tell it.

    Where the lag is over within a sample a single pole of 12 ms and two that sum to 22 ms are one to them.
    """
    problem = fit.problem
    values = values_of(fit)
    if not leaves_the_trace_of_l(problem) or fit.parameters["L"].value is not None:
        return None
    braking = values["B"] * values["R"] + values["K"] ** 2
    slow = (values["J"] * values["R"] + values["L"] * values["B"]) / braking
    other = again(problem.plant.effects, {**values, "L": values["R"] * slow}, ("R", "L"))
    if other is None or other.solution.point.value > fit.plain.point.value + _TOLD:
        return None
    return other


def values_of(fit: OutputErrorFit) -> dict[str, float]:
    """Natural values of all parameters where the fit has ended, of what is not determined as well."""
    return natural_values(fit.problem.plant.parameters, fit.problem.coordinates(fit.solution.point.unknowns, 0))


def halved_lag(values: Mapping[str, float], name: str) -> Mapping[str, float]:
    """Where a search begins that shares the winding's lag between L and this parameter."""
    return {**values, "L": values["L"] / 2.0, name: values["L"] / values["R"] / 2.0}


def moved_to(other: OutputErrorFit, fit: OutputErrorFit) -> F64:
    """By how much another model's fit moves the coordinates of the free parameters, shape (k,)."""
    there = dict(zip(other.problem.parameter_of_column, other.solution.point.unknowns, strict=False))
    names = fit.problem.parameter_of_column
    moved = [there[n] - fit.solution.point.unknowns[k] if n in there else 0.0 for k, n in enumerate(names)]
    return bounded_move(np.array(moved))


def bounded_move(moved: F64) -> F64:
    """With no coordinate moved by more than a logarithm may be."""
    return np.clip(moved, -_AT_MOST, _AT_MOST)


def is_cut_off(moved: F64) -> bool:
    """Whether a coordinate would have moved further: then those that make up for each other no longer do."""
    return bool(np.max(np.abs(moved), initial=0.0) >= _AT_MOST)


def _poles(q: Mapping[str, float]) -> tuple[float, float] | None:
    """Time constants, s, the faster first; None where they are no real ones."""
    braking = q["B"] * q["R"] + q["K"] ** 2
    p, square = (q["J"] * q["R"] + q["L"] * q["B"]) / braking, q["J"] * q["L"] / braking
    root = p * p - 4.0 * square
    return None if root <= 0.0 else ((p - root**0.5) / 2.0, (p + root**0.5) / 2.0)
