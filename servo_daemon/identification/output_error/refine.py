"""The maximum-likelihood estimate under noise that enters the motor: Gauss–Newton on whitened residuals.

Output error weighs every sample alike. Where noise enters the motor, its residuals are coloured, its weights wrong and
its standard deviations too small; in closed loop, where the recorded input answers to that noise, it is biased. Here
residuals and sensitivities go through the same Kalman filter (`whitening`), and

    Σ J̃ᵀ ε̃ = 0

is solved, relinearised until nothing moves. The filter is causal and the sensitivities are those of the free run, which
knows the input only: with the right noise model an innovation is independent of all that came before it, the input's
answers included, so that the equation holds on average at the true parameters, in closed loop as well (Ljung, *System
Identification*, 2nd ed. 1999, sec. 8.4; Jategaonkar, *Flight Vehicle System Identification*, 2nd ed. 2015, ch. 5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from servo_daemon.identification.output_error.noise.noise import (
    INPUT_NOISE,
    TORQUE_NOISE,
    WORTH,
    NoiseLikelihood,
    NoiseModel,
    bounds,
    likelihood_of,
    noise_model,
)
from servo_daemon.identification.output_error.noise.whitening import channel_weights, moving, tangents
from servo_daemon.identification.output_error.problem.event_times import event_times_of, profile
from servo_daemon.identification.output_error.problem.linearisation import linearise
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.refinement_step import (
    FAINT,
    downhill,
    held_at_bounds,
    limited,
    moved_by,
    newton_step,
    shortened,
)
from servo_daemon.identification.output_error.solver.solver import (
    Point,
    normal_equations,
    point_of,
)
from servo_daemon.identification.output_error.whitened_point import whiten_point, whitened_value
from servo_daemon.samples import F64

#: Most steps.
_STEPS = 30
#: A step that promises less than this, a standard deviation, is taken unasked: what the filter's own change with the
#: parameters does to the likelihood is left out of the equations and may be as large.
_ASKED = 1.0
#: A step left over that is not smaller than this share of the last one has gone too far: the next are halved, and at
#: the least share of a step nothing will move any more.
_PROGRESS, _LEAST_SHARE = 0.8, 1 / 256
#: Settled when the step left over is this many standard deviations, squared, and no variance changes by a larger share;
#: close enough where it comes no nearer.
_DECREMENT, _SAME, _CLOSE = 1e-4, 0.01, 0.01
#: A step promises what −2 log p falls by; over the steps that follow it fell by 0.4 to 1.2 times the promise, on hidden
#: effects and clean captures alike. What would take more than this many times the promise is out of reach.
_REACH = 3.0
#: How often the likeliest instant and the rest are looked for in turn.
_EVENT_TIME_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Refined:
    """Where the likelihood is largest.

    Attributes:
        point: of the free run there.
        whitened: the same with innovations for residuals, in units of their σ.
        noise: the noise model.
        log_variance: of the noises, as the filter takes them.
        deviance: −2 log p with them, Σ log s + Σ ε².
        torque_gain: by how much a white load torque beside it would lower −2 log p.
        innovation_rms: shape (c,), in the channels' units.
        at_bound: columns of parameters that ended at a bound.
        event_time_std: of the columns of event times, s: what no derivative tells.
        remaining: what a further step promises −2 log p to fall by.
    """

    point: Point
    whitened: Point
    noise: NoiseModel
    log_variance: F64
    deviance: float
    torque_gain: float
    innovation_rms: F64
    at_bound: frozenset[int]
    event_time_std: Mapping[int, float]
    remaining: float

    @property
    def at_rest(self) -> bool:
        """Whether the search came to its end. Under a model that is far off its valley is curved so much that no step
        along its slope is better."""
        return self.remaining < _CLOSE

    @property
    def at_best(self) -> float:
        """What −2 log p is, or may come to at the best."""
        return self.deviance if self.at_rest else self.deviance - _REACH * self.remaining


def refine(problem: Problem, point: Point, torque_size: float, below: float = np.inf) -> Refined | None:
    """From the plain output-error estimate, to where its search ends; None where no noise but the sensors' is seen, or
    it was given up.

    Args:
        torque_size: N·m, what the motor typically exerts.
        below: given up where −2 log p will not come below this.
    """
    limits = bounds(problem, torque_size)
    at = _likelihood(problem, point, limits)
    alone = at.sensors_alone()
    plain = at.value(alone)
    a, value = at.with_source(alone, INPUT_NOISE)
    end = _settle(problem, point, a, limits, below) if value < plain - WORTH else None
    event_time_std: dict[int, float] = {}
    if end is not None and end.at_rest and event_times_of(problem):
        end, event_time_std = _settle_event_times(problem, end, limits, below)
    if end is None:
        return None
    point, a = end.point, end.log_variance
    deviance = _likelihood(problem, point, limits).value(a)
    whitened, rms = whiten_point(problem, point, a)
    torque = _torque_gain(problem, point, a, limits) if end.at_rest else np.inf
    noise = noise_model(problem, a, plain - deviance)
    at_bound = _at_bound(problem, whitened)
    return Refined(point, whitened, noise, a, deviance, torque, rms, at_bound, event_time_std, end.remaining)


def with_lost_seen(problem: Problem, point: Point, log_variance: F64) -> Point | None:
    """The point with positive parameters that a search has driven to nothing put one standard deviation (all else held)
    away from it: at nothing their logarithms have no derivative, and neither a way back nor a share in what the others
    are known by. None: there are none."""
    whitened, _ = whiten_point(problem, point, log_variance)
    known = np.diag(normal_equations(problem, whitened)[0])
    lost = problem.logarithmic & (known > 0.0) & (known < FAINT)
    if not lost.any():
        return None
    step = np.zeros(len(known))
    step[lost] = -0.5 * np.log(known[lost])
    return moved_by(problem, point, step)


@dataclass(frozen=True, slots=True)
class _End:
    """Free run, the same whitened, log variances; see `Refined`."""

    point: Point
    whitened: Point
    log_variance: F64
    remaining: float

    @property
    def at_rest(self) -> bool:
        return self.remaining < _CLOSE


def _settle_event_times(
    problem: Problem, end: _End, limits: tuple[F64, F64], below: float
) -> tuple[_End, dict[int, float]]:
    """From the likeliest times of the steps that the model holds, and how well these are known."""
    std: dict[int, float] = {}
    for column in event_times_of(problem):
        for _ in range(_EVENT_TIME_ROUNDS):
            here = float(end.point.unknowns[column])
            there, std[column] = profile(problem, column, here, partial(_deviance_at, problem, end, column))
            if there == here:
                break
            moved = _moved(problem, end.point, column, there)
            again = _settle(problem, moved, end.log_variance, limits, below)
            if again is None or not again.at_rest or again.whitened.value > end.whitened.value:
                break
            end = again
    return end, std


def _moved(problem: Problem, point: Point, column: int, at_s: float) -> Point:
    unknowns = point.unknowns.copy()
    unknowns[column] = at_s
    with np.errstate(over="ignore", invalid="ignore"):
        return point_of(problem, unknowns, linearise(problem, unknowns), point.weights)


def _deviance_at(problem: Problem, end: _End, column: int, at_s: float) -> float:
    """−2 log p with one event at another time and all else as it is."""
    moved = _moved(problem, end.point, column, at_s)
    return whitened_value(problem, moved, end.log_variance) if moved.linearisation.finite else np.inf


def _torque_gain(problem: Problem, point: Point, a: F64, limits: tuple[F64, F64]) -> float:
    """By how much a white load torque would lower −2 log p. Samples of an encoder at rest are left out: one rounding
    error, repeated, can be mistaken for a torque that holds the shaft."""
    weights = [w * m for w, m in zip(channel_weights(problem, point.weights), moving(problem), strict=True)]
    at = likelihood_of(tangents(problem, point.unknowns), weights, point.linearisation.residuals, limits)
    a, value = at.refine(a)
    return value - at.with_source(a, TORQUE_NOISE)[1]


def _settle(problem: Problem, point: Point, a: F64, limits: tuple[F64, F64], below: float) -> _End | None:
    """Where the search ends; None if it does not come below the value.

    By steps that are shortened where they are not better; if these do not come to rest, by damped ones, if those do.
    Not without a current: noise of the input is not told from a torque there, and a search that follows a valley far
    enough finds noise that passes for a load which the model lacks.
    """
    end = _search(problem, point, a, limits, below, damped=False)
    if end is None or end.at_rest or "current_A" not in problem.channels:
        return end
    other = _search(problem, point, a, limits, below, damped=True)
    return other if other is not None and other.at_rest else end


def _search(
    problem: Problem, point: Point, a: F64, limits: tuple[F64, F64], below: float, *, damped: bool
) -> _End | None:
    """Steps of the parameters and of the noise in turn, until neither moves or none is better; None if they do not come
    below the value.

    In turn, because the noise as seen from a poor estimate leads astray where the data say little.
    """
    settled, share, last, damping = False, 1.0, np.inf, 0.0
    whitened, _ = whiten_point(problem, point, a)
    for steps in range(_STEPS):
        step, decrement = newton_step(problem, whitened)
        if steps > 0 and whitened.value - _REACH * decrement > below:
            return None
        to_and_fro = decrement > _PROGRESS * last and (decrement < _ASKED or not damped)
        share, last = (share / 2 if to_and_fro else share), decrement
        if share < _LEAST_SHARE:
            break
        if decrement < _DECREMENT and settled:
            break
        better = None
        if decrement >= _ASKED and damped:
            better, damping = downhill(problem, (point, whitened), a, damping)
        elif decrement >= _ASKED:
            better = shortened(problem, (point, whitened), a, share * step)
        elif decrement >= _DECREMENT:
            better = moved_by(problem, point, limited(problem, share * step))
        if better is not None:
            point = better
        elif settled:
            break
        before, (a, _) = a, _likelihood(problem, point, limits).refine(a)
        settled = bool(np.allclose(np.exp(a), np.exp(before), rtol=_SAME, atol=0.0))
        whitened, _ = whiten_point(problem, point, a)
    return _End(point, whitened, a, newton_step(problem, whitened, held=event_times_of(problem))[1])


def _at_bound(problem: Problem, whitened: Point) -> frozenset[int]:
    _, g = normal_equations(problem, whitened)
    held = np.flatnonzero(held_at_bounds(problem, whitened.unknowns, g))
    return frozenset(int(k) for k in held if k < len(problem.parameter_of_column))


def _likelihood(problem: Problem, point: Point, limits: tuple[F64, F64]) -> NoiseLikelihood:
    return likelihood_of(
        tangents(problem, point.unknowns),
        channel_weights(problem, point.weights),
        point.linearisation.residuals,
        limits,
    )
