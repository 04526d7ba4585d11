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

from dataclasses import dataclass

import numpy as np

from servo_daemon.estimators.output_error.noise import NoiseLikelihood, NoiseModel, bounds, fit_noise
from servo_daemon.estimators.output_error.problem import Linearisation, Problem
from servo_daemon.estimators.output_error.solver import Point, normal_equations, stepped
from servo_daemon.estimators.output_error.whitening import channel_weights, tangents, whiten
from servo_daemon.samples import F64

#: Rounds of noise and parameters; both have settled after two or three.
_ROUNDS = 4
_STEPS = 20
#: Variances that change by a smaller share have settled.
_SAME = 0.01
_HALVINGS = 6
#: Settled when the step left over is this many standard deviations, squared.
_DECREMENT = 1e-4


@dataclass(frozen=True, slots=True)
class Polished:
    """Where the likelihood is largest.

    Attributes:
        point: of the free run there.
        whitened: the same with innovations for residuals, in units of their σ.
        noise: the noise model.
        at_bound: columns of parameters that ended at a bound.
    """

    point: Point
    whitened: Point
    noise: NoiseModel
    at_bound: frozenset[int]


def polish(problem: Problem, point: Point, torque_size: float) -> Polished | None:
    """From the plain output-error estimate; None where no noise but the sensors' is seen, or no estimate is found.

    Args:
        torque_size: N·m, what the motor typically exerts.
    """
    sources = (0, 1) if problem.plant.drive == "voltage" else (0,)
    limits = bounds(problem, torque_size)
    noise, a = fit_noise(problem, _likelihood(problem, point, limits), sources)
    if not noise.sources:
        return None
    for _ in range(_ROUNDS):
        found = _minimise(problem, point, a)
        if found is None:
            return None
        point, whitened, at_bound = found
        before = a
        noise, a = fit_noise(problem, _likelihood(problem, point, limits), sources, a)
        if np.allclose(np.exp(a), np.exp(before), rtol=_SAME, atol=0.0):
            break
    return Polished(point, whiten_point(problem, point, a), noise, at_bound)


def _likelihood(problem: Problem, point: Point, limits: tuple[F64, F64]) -> NoiseLikelihood:
    weights = channel_weights(problem, point.weights)
    return NoiseLikelihood(tangents(problem, point.unknowns), weights, point.linearisation.residuals, *limits)


def whiten_point(problem: Problem, point: Point, log_variance: F64) -> Point:
    """Residuals and sensitivities through the filter, in units of the innovations' σ; its value is −2 log p."""
    residuals, jacobians, logs = [], [], 0.0
    for model, w, r, J in zip(
        tangents(problem, point.unknowns),
        channel_weights(problem, point.weights),
        point.linearisation.residuals,
        point.linearisation.jacobian,
        strict=True,
    ):
        out = whiten(model, w, np.concatenate([r[:, :, None], J], axis=2), np.exp(log_variance))
        residuals.append(out.values[:, :, 0])
        jacobians.append(out.values[:, :, 1:])
        logs += float(out.log_variance.sum())
    ones = tuple(np.ones_like(r) for r in residuals)
    sse = np.sum([(r * r).sum(axis=0) for r in residuals], axis=0)
    linear = Linearisation(tuple(residuals), tuple(jacobians), True)
    mean, prior = problem.state_prior()
    value = logs + float(sse.sum() + prior @ (point.unknowns - mean) ** 2)
    return Point(point.unknowns, linear, ones, sse, np.ones(len(problem.channels)), value)


def _minimise(problem: Problem, point: Point, a: F64) -> tuple[Point, Point, frozenset[int]] | None:
    """Gauss–Newton with the noise held; None if it does not settle."""
    low, high = problem.bounds
    whitened = whiten_point(problem, point, a)
    for _ in range(_STEPS):
        H, g = normal_equations(problem, whitened)
        free = ~((point.unknowns <= low) & (g < 0) | (point.unknowns >= high) & (g > 0))
        step, decrement = stepped(H, g, free, problem.logarithmic)
        if decrement < _DECREMENT:
            stuck = frozenset(int(k) for k in np.flatnonzero(~free) if k < len(problem.parameter_of_column))
            return point, whitened, stuck
        better = _along(problem, (point, whitened), step, a, decrement)
        if better is None:
            return None
        point, whitened = better
    return None


def _along(
    problem: Problem, here: tuple[Point, Point], step: F64, a: F64, decrement: float
) -> tuple[Point, Point] | None:
    """The first point along the step, halved at most `_HALVINGS` times, that is as good as this one. A step of less
    than a standard deviation is not asked: what the filter's own change with the parameters does to the likelihood is
    left out of the equations and may be as large."""
    low, high = problem.bounds
    point, whitened = here
    for halved in range(_HALVINGS):
        unknowns = np.clip(point.unknowns + step / 2**halved, low, high)
        with np.errstate(over="ignore", invalid="ignore"):
            linear = problem.linearise(unknowns)
        if not linear.finite:
            continue
        sse = np.sum([(w * r * r).sum(axis=0) for w, r in zip(point.weights, linear.residuals, strict=True)], axis=0)
        trial = Point(unknowns, linear, point.weights, sse, np.sqrt(sse / problem.counts), point.value)
        trial_whitened = whiten_point(problem, trial, a)
        if decrement < 1.0 or trial_whitened.value < whitened.value:
            return trial, trial_whitened
    return None
