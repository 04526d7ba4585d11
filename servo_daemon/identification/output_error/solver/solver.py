"""Bounded Gauss–Newton with Levenberg–Marquardt damping for the output-error likelihood.

With white noise of unknown size in every channel the negative log-likelihood, its variances at their best, is

    V = Σ_c n_c log(SSE_c)

(Ljung, *System Identification*, 2nd ed. 1999, sec. 7.4; Jategaonkar, *Flight Vehicle System Identification*, 2nd ed.
2015, sec. 4.5). Its Gauss–Newton step is that of least squares weighted by σ_c² = SSE_c/n_c of the present point: the
channels balance themselves, and a decrease of V counts in units of 2 log-likelihood, in which "converged" has a
meaning: the step still to go is a small part of a standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error.problem.linearisation import Linearised, linearise
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.solver.bordered import solve_bordered
from servo_daemon.identification.output_error.solver.robust import sample_weights
from servo_daemon.samples import F64

#: Converged when the step left over would lower V by less: 0.02 standard deviations.
_DECREMENT = 4e-4
#: … or when V cannot be lowered by more than rounding leaves of it.
_RELATIVE = 1e-12
#: … or when it has fallen by less than this so many times in a row: dry friction makes steps in it that no slope shows.
_LITTLE, _IN_A_ROW = 0.2, 3
#: No parameter changes by a factor of more than six in one step: R, K and B all scale the response, and three leaps
#: that each would be right alone are far too much together.
_LONGEST_STEP = 5.0
#: A sensor shows no less of its signal: 20 bits. It keeps the weights finite on data without noise.
_FINEST = 1e-6
#: A step that promises this share of the whole way, and keeps this share of its promise, needs no other beside it.
_AS_PROMISED = 0.7
#: The acceleration may be this share of the step (Transtrum & Sethna ask for 2 |a|/|v| ≤ 0.75).
_MOST_CURVED = 0.375
#: A step that promises less (in V) is short enough to be straight.
_STRAIGHT = 1.0
#: Of a step, as shares of the curvature: the least is rounding, beyond the most nothing moves.
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-13, 1e12
#: Keeps a direction that the data do not show where it is, in units of what each unknown is known by.
RIDGE = 1e-10


@dataclass(frozen=True, slots=True)
class Iteration:
    """One line of the table: number, rollouts so far, sum of squares by channel, unknowns."""

    number: int
    evaluations: int
    sse: F64
    unknowns: F64


@dataclass(frozen=True, slots=True)
class Point:
    """A point with all that is known there.

    Attributes:
        unknowns: shape (k,).
        linearisation: residuals and derivatives.
        weights: per segment, shape (n, c): 1, less for isolated wrong samples.
        sse: shape (c,), weighted sums of squares.
        sigma: shape (c,), the residuals' RMS (never below what a sensor can resolve).
        value: V.
    """

    unknowns: F64
    linearisation: Linearised
    weights: tuple[F64, ...]
    sse: F64
    sigma: F64
    value: float


@dataclass(frozen=True, slots=True)
class Solution:
    """Where the search ended, how, and the way there."""

    point: Point
    iterations: tuple[Iteration, ...]
    converged: bool
    at_bound: frozenset[int] = field(default_factory=frozenset)


def solve(
    problem: Problem,
    start: F64,
    *,
    robust: bool = True,
    max_iterations: int = 60,
    give_up: Callable[[Point], bool] | None = None,
    enough: float = 0.0,
    curved: bool = True,
) -> Solution | None:
    """Minimise from one start; None if the model cannot even be simulated there.

    Args:
        start: shape (unknowns,).
        robust: whether isolated wrong samples lose weight.
        give_up: asked after every iteration: whether this way leads where another has been already.
        enough: the search is over when an iteration lowers V by less.
        curved: whether steps follow the bend of narrow valleys, at the price of one more simulation each.
    """
    point = _evaluate(problem, within(problem, start), None)
    if point is None:
        return None
    point = _reweigh(problem, point) if robust else point
    iterations = [Iteration(0, 1, point.sse, point.unknowns)]
    evaluations, damping, converged = 1, _FIRST_DAMPING, False
    free, gains = np.ones(len(start), dtype=bool), [np.inf]
    while len(iterations) <= max_iterations:
        H, g = normal_equations(problem, point)
        low, high = problem.bounds_at(point.unknowns)
        free = ~((point.unknowns <= low) & (g < 0) | (point.unknowns >= high) & (g > 0))
        if converged or _decrement(problem, H, g, free) < _DECREMENT:
            converged = True
            break
        better, damping, tried = _search(problem, point, (H, g, free), damping, curved)
        evaluations += tried
        if better is None:  # no step helps at any damping: the bottom, as far as a cost with kinks has one
            converged = True
            break
        gains = [*gains[1 - _IN_A_ROW :], point.value - better.value]
        converged = gains[-1] < max(_RELATIVE * abs(point.value), enough) or (
            len(gains) == _IN_A_ROW and max(gains) < _LITTLE
        )
        point = _reweigh(problem, better) if robust else better
        iterations.append(Iteration(len(iterations), evaluations, point.sse, point.unknowns))
        if give_up is not None and give_up(point):
            break
    stuck = frozenset(int(k) for k in np.flatnonzero(~free) if k < len(problem.parameter_of_column))
    return Solution(point, tuple(iterations), converged, stuck)


def within(problem: Problem, unknowns: F64) -> F64:
    """The unknowns, clipped to their bounds; a phase is turned back instead: whole turns further it is the same."""
    low, high = problem.bounds
    turns = np.round(unknowns / (2.0 * np.pi))
    beyond = problem.is_phase & ((unknowns < low) | (unknowns > high))
    clipped = np.clip(np.where(beyond, unknowns - 2.0 * np.pi * turns, unknowns), low, high)
    return np.asarray(np.minimum(clipped, problem.bounds_at(clipped)[1]))


def _search(
    problem: Problem, point: Point, equations: tuple[F64, F64, NDArray[np.bool_]], damping: float, curved: bool
) -> tuple[Point | None, float, int]:
    """The best point along the Levenberg–Marquardt curve, near the last damping.

    Damping rises until V falls; then it is lowered as long as that lowers V more. A Jacobian costs no more than a
    simulation here, but far from the minimum the direction that one Jacobian gives is worth looking along.

    Returns:
        the point (None: none is better), the damping to begin with next, how many points were simulated.
    """
    H, g, free = equations
    whole = _decrement(problem, H, g, free)
    best, best_damping, tried = None, damping, 0
    while damping < _MOST_DAMPING:
        step = _step(problem, H, g, free, damping)
        promised = float(2 * g @ step - step @ H @ step)
        if curved and promised > _STRAIGHT:
            step_bent = step + _acceleration(problem, point, (H, free), step, damping)
            tried += 1
        else:
            step_bent = step
        trial = _evaluate(problem, within(problem, _moved(problem, point.unknowns, step_bent)), point.weights)
        tried += 1
        if trial is None or point.value - trial.value <= 1e-4 * promised:
            if best is not None:
                break
            damping *= 8.0
            continue
        if best is not None and trial.value >= best.value:
            break
        best, best_damping = trial, damping
        kept = point.value - trial.value > _AS_PROMISED * promised and promised > _AS_PROMISED * whole
        if kept or damping <= _LEAST_DAMPING:
            break
        damping = max(damping / 16.0, _LEAST_DAMPING)
    return best, max(best_damping / 16.0, _LEAST_DAMPING), tried


def _evaluate(problem: Problem, unknowns: F64, weights: tuple[F64, ...] | None) -> Point | None:
    """The point, or None where the simulation leaves the range of numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        linearisation = linearise(problem, unknowns)
    if not linearisation.finite:
        return None
    weights = weights or tuple(np.ones_like(r) for r in linearisation.residuals)
    return point_of(problem, unknowns, linearisation, weights)


def _reweigh(problem: Problem, point: Point) -> Point:
    return point_of(problem, point.unknowns, point.linearisation, sample_weights(point.linearisation.residuals))


def in_units_of_each(H: F64) -> tuple[F64, F64]:
    """Normal equations' matrix in units of what each unknown is known by, with `RIDGE`, and those units' inverses."""
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    return H / np.outer(size, size) + RIDGE * np.eye(len(size)), size


def mean_squares(problem: Problem, sums: F64) -> F64:
    """Sums of squares over each channel's samples, shape (c,); a channel without any is left as it is: in the beginning
    of a run all samples may be held out."""
    return sums / np.maximum(problem.counts, 1.0)


def point_of(problem: Problem, unknowns: F64, linearisation: Linearised, weights: tuple[F64, ...]) -> Point:
    sse = np.sum([(w * r * r).sum(axis=0) for w, r in zip(weights, linearisation.residuals, strict=True)], axis=0)
    floor = (_FINEST * problem.spread) ** 2
    variance = mean_squares(problem, sse) + floor
    mean, prior = problem.state_prior
    value = float(problem.counts @ np.log(variance) + prior @ (unknowns - mean) ** 2)
    return Point(unknowns, linearisation, weights, sse, np.sqrt(variance), value)


def normal_equations(problem: Problem, point: Point) -> tuple[F64, F64]:
    """H = Jᵀ W J and g = Jᵀ W r over all unknowns, in units of the residuals' σ; the priors of states included."""
    n = problem.n_unknowns
    mean, prior = problem.state_prior
    H, g = np.diag(prior), prior * (mean - point.unknowns)
    for k, (r, J, w) in enumerate(
        zip(point.linearisation.residuals, point.linearisation.jacobian, point.weights, strict=True)
    ):
        where = problem.columns(k)
        root = np.sqrt(w) / point.sigma
        A = (J * root[:, :, None]).reshape(-1, J.shape[2])
        H[np.ix_(where, where)] += A.T @ A
        g[where] += A.T @ (root * r).ravel()
    assert H.shape == (n, n)
    return H, g


def _moved(problem: Problem, unknowns: F64, step: F64) -> F64:
    """The point after a step. A logarithm's step δ multiplies the parameter by 1 + δ, or divides it by 1 + |δ| if it is
    negative: to first order the same as e^δ, but what is shown is nearly linear in a torque constant that is 60 times
    too small, and so the long first steps land where they were meant to."""
    out = unknowns + step
    logs = problem.logarithmic
    out[logs] = unknowns[logs] + np.sign(step[logs]) * np.log1p(np.abs(step[logs]))
    return out


def _acceleration(
    problem: Problem, point: Point, equations: tuple[F64, NDArray[np.bool_]], step: F64, damping: float
) -> F64:
    """What curves the way: geodesic acceleration (Transtrum & Sethna, arXiv:1201.5885), which follows the narrow curved
    valleys of a model with more parameters than the data show. Zero where it would be most of the step.

    The second directional derivative of what is shown is taken by one more simulation a tenth of the way along.
    """
    H, free = equations
    h = 0.1
    with np.errstate(over="ignore", invalid="ignore"):
        ahead = linearise(problem, _moved(problem, point.unknowns, h * step))
    if not ahead.finite:
        return np.zeros_like(step)
    g = np.zeros_like(step)
    here = point.linearisation
    for k, (r0, r1, J, w) in enumerate(zip(here.residuals, ahead.residuals, here.jacobian, point.weights, strict=True)):
        where = problem.columns(k)
        second = 2.0 / h * ((r0 - r1) / h - J @ step[where])
        root = np.sqrt(w) / point.sigma
        g[where] -= (J * root[:, :, None]).reshape(-1, J.shape[2]).T @ (root * second).ravel()
    bend = 0.5 * _solved(problem, H, g, free, damping)
    metric = np.sqrt(np.diag(H))
    length = float(np.linalg.norm(metric * step))
    return bend if float(np.linalg.norm(metric * bend)) <= _MOST_CURVED * length else np.zeros_like(step)


def _solved(problem: Problem, H: F64, g: F64, free: NDArray[np.bool_], damping: float) -> F64:
    """The equations with damping: alike for all logarithms, so that a parameter that is hardly seen does not run off;
    for states and offsets, whose units differ, each by its own size."""
    d = np.diag(H).copy()
    d = np.maximum(d, 1e-12 * float(np.max(d[free], initial=0.0)))
    logarithmic = problem.logarithmic & free
    if logarithmic.any():
        d[logarithmic] = np.mean(d[logarithmic])
    return solve_bordered(H, g, free, damping * d, len(problem.parameter_of_column), len(problem.plant.states))


def _decrement(problem: Problem, H: F64, g: F64, free: NDArray[np.bool_]) -> float:
    """What a full step promises, over the directions the data show."""
    return float(g @ _solved(problem, H, g, free, _LEAST_DAMPING)) if free.any() else 0.0


def _step(problem: Problem, H: F64, g: F64, free: NDArray[np.bool_], damping: float) -> F64:
    """The damped step, shortened where a parameter would leap."""
    step = _solved(problem, H, g, free, damping)
    longest = float(np.max(np.abs(step[problem.logarithmic]), initial=0.0))
    return step if longest <= _LONGEST_STEP else step * (_LONGEST_STEP / longest)
