"""A point of the fit with its residuals and sensitivities as the innovations of a Kalman filter."""

from __future__ import annotations

import numpy as np

from servo_daemon.identification.output_error.noise.whitening import channel_weights, tangents, whiten
from servo_daemon.identification.output_error.problem.linearisation import Linearisation
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.solver.solver import Point, mean_squares
from servo_daemon.samples import F64


def whitened_value(problem: Problem, point: Point, log_variance: F64) -> float:
    """The value of `whiten_point`, −2 log p, without the sensitivities."""
    parts = zip(
        tangents(problem, point.unknowns),
        channel_weights(problem, point.weights),
        point.linearisation.residuals,
        strict=True,
    )
    variance = np.exp(log_variance)
    out = [whiten(model, w, r[:, :, None], variance) for model, w, r in parts]
    sse = np.sum([(o.values[:, :, 0] ** 2).sum(axis=0) for o in out], axis=0)
    return _value(problem, point, sse, sum(float(o.log_variance.sum()) for o in out))


def whiten_point(problem: Problem, point: Point, log_variance: F64) -> tuple[Point, F64]:
    """Residuals and sensitivities through the filter, in units of the innovations' σ; its value is −2 log p.

    Returns:
        that point, and the RMS of the innovations in the channels' units, shape (c,).
    """
    residuals, jacobians, logs, squares = [], [], 0.0, np.zeros(len(problem.channels))
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
        squares += (residuals[-1] ** 2 * np.exp(out.log_variance)).sum(axis=0)
    ones = tuple(np.ones_like(r) for r in residuals)
    sse = np.sum([(r * r).sum(axis=0) for r in residuals], axis=0)
    linear = Linearisation(tuple(residuals), tuple(jacobians), True)
    value = _value(problem, point, sse, logs)
    whitened = Point(point.unknowns, linear, ones, sse, np.ones(len(problem.channels)), value)
    return whitened, np.sqrt(mean_squares(problem, squares))


def _value(problem: Problem, point: Point, sse: F64, logs: float) -> float:
    mean, prior = problem.state_prior
    return logs + float(sse.sum() + prior @ (point.unknowns - mean) ** 2)
