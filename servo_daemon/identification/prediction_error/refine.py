"""A fit whose free runs noise biases, made again by what each sample is predicted to be.

Where dry friction may hold the shaft, a voltage noise that no recording shows does not average out: it decides when the
shaft lets go, and free runs through such moments are no smooth function of anything. Fitted to them the parameters of
friction near standstill are off by percents at several of their standard deviations. The likelihood of the predictions
(`predictor`) is maximised over parameters and noise together, from where the free runs have led.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.noise.noise import (
    DIFFERENCE,
    INPUT_NOISE,
    LONGEST,
    NoiseModel,
    bounds,
    resolution,
)
from servo_daemon.identification.output_error.noise.residual import ResidualTest, innovation_tests
from servo_daemon.identification.output_error.noise.scoring import Axes, Found, deviance, fisher_scoring
from servo_daemon.identification.output_error.noise.whitening import SOURCES, moving
from servo_daemon.identification.output_error.precision.information import Information, wider
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.identification.output_error.republished import republished, uncut, with_settled_states
from servo_daemon.identification.prediction_error.predictor import Predictions, Predictor, predictor
from servo_daemon.numerics import inverse_of_information
from servo_daemon.regression.sampling import settles_between
from servo_daemon.samples import F64

#: Share of a standard deviation by which a parameter is moved for a derivative; bounds of that, and the longest step,
#: of a logarithm.
_MOVED, _LEAST, _MOST, _LONGEST = 0.03, 1e-6, 1e-3, 0.3
#: From so many standard deviations (of the free runs) to either side a search must come back to the same place: within
#: so many of the predictions' own, or a share of one unit. No logarithm begins further away than by the longest step.
_AWAY, _SAME_STDS, _SAME_SHARE = 2.0, 3.0, 5e-3
#: 1 σ of the noises against their signals, to begin with.
_INPUT_SHARE, _SENSOR_SHARE = 5e-3, 5e-3


def predicted_fit(fit: OutputErrorFit, recordings: Sequence[Recording]) -> OutputErrorFit | None:
    """The same model with the parameters that predict best; None where these do not explain the data to their noise.

    Args:
        fit: of voltage-driven motors with a current measured at the samples; where it begins, and what is not
            determined stays there.
        recordings: the same.
    """
    plant = fit.problem.plant
    if plant.drive != "voltage" or "current_A" not in fit.problem.channels or plant.mean_current:
        return None
    problem, unknowns = _uncut(fit, recordings)
    at = predictor(problem, unknowns, _weights(fit, problem))
    columns = _open_columns(fit)
    axes = _axes(fit, problem)
    found = _most_likely(fit, at, axes, unknowns, columns)
    if found is None:
        return None
    n = len(problem.parameter_of_column)
    moved = unknowns.copy()
    moved[columns] = found.at[columns]
    a = found.at[n:]
    tests = _tests(problem, at.run(moved, a))
    if not all(test.white for test in tests.values()):
        return None
    known = _information(fit.after, found, columns)
    for away in (-_AWAY, _AWAY):
        other = _most_likely(fit, at, axes, _other_start(fit, moved, away), columns)
        if other is None or not _agree(known, moved[columns], other.at[columns], columns):
            return None
    known = wider(known, _hidden_by_sampling(fit, moved))
    return _published(fit, known, moved, a, tests)


def _hidden_by_sampling(fit: OutputErrorFit, unknowns: F64) -> dict[int, float]:
    """1 σ that the inductance of a winding much faster than the sampling has at least, by column: it shows in the
    colour of the noise alone, which a shaft that sticks changes, and is known no better than free runs and predictions
    agree on it."""
    names, problem = fit.problem.parameter_of_column, fit.problem
    if not {"R", "L"} <= set(names):
        return {}
    R, column = np.exp(unknowns[names.index("R")]), names.index("L")
    if not settles_between(float(R), float(np.exp(unknowns[column])), problem.sample_period_s):
        return {}
    return {column: abs(float(unknowns[column] - fit.solution.point.unknowns[column]))}


def _other_start(fit: OutputErrorFit, unknowns: F64, away: float) -> F64:
    """Along what the free runs know least, as far as they leave it open: each time that the shaft lets go a sample
    earlier or later the likelihood has a step, and where the data say little such steps are all that it shows."""
    root = fit.after.root
    size = np.maximum(np.sqrt(np.diag(fit.after.covariance)), 1e-300)
    u, spread, _ = np.linalg.svd(root / size[:, None], full_matrices=False)
    way = away * spread[0] * size * u[:, 0]
    furthest = float(np.max(np.abs(way[fit.problem.logarithmic[: len(way)]]), initial=0.0))
    way *= min(1.0, _LONGEST / max(furthest, 1e-300))
    out = unknowns.copy()
    out[: len(way)] += way
    return out


def _agree(known: Information, one: F64, other: F64, columns: list[int]) -> bool:
    """Whether two searches came to the same place."""
    std = np.sqrt(np.diag(known.covariance))[columns]
    return bool((np.abs(one - other) <= np.hypot(_SAME_STDS * std, _SAME_SHARE)).all())


def _uncut(fit: OutputErrorFit, recordings: Sequence[Recording]) -> tuple[Problem, F64]:
    """The problem in as few segments as the recordings allow, and the fit's unknowns there."""
    own = fit.problem
    problem = uncut(own, recordings)
    unknowns = problem.start(dict.fromkeys(problem.parameter_of_column, 0.0))
    n = len(problem.parameter_of_column)
    unknowns[:n] = fit.solution.point.unknowns[:n]
    first = {s.recording: k for k, s in reversed(list(enumerate(own.segments)))}
    for k, segment in enumerate(problem.segments):
        if segment.recording in first:  # else all its pieces were too short
            state = own.initial_state(fit.solution.point.unknowns, first[segment.recording])
            unknowns[problem.columns(k)[-len(own.plant.states) :]] = state
    return problem, unknowns


def _weights(fit: OutputErrorFit, problem: Problem) -> tuple[F64, ...]:
    """The samples' weights in the fit, per segment of the uncut problem."""
    pieces = list(zip(fit.problem.segments, fit.solution.point.weights, strict=True))
    out = []
    for segment in problem.segments:
        weights = np.ones(segment.measured.shape)
        end = segment.begin + len(weights)
        for piece, w in pieces:
            if piece.recording == segment.recording and segment.begin <= piece.begin < end:
                weights[piece.begin - segment.begin :][: len(w)] = w
        out.append(weights)
    return tuple(out)


def _open_columns(fit: OutputErrorFit) -> list[int]:
    """Parameters that the data determine and that are at no bound."""
    lost = fit.after.undetermined
    return [k for k in range(len(fit.problem.parameter_of_column)) if not lost[k] and k not in fit.solution.at_bound]


def _axes(fit: OutputErrorFit, problem: Problem) -> Axes:
    """Parameters, then the log-variances of the voltage and of each channel."""
    n = len(problem.parameter_of_column)
    low, high = (b[:n] for b in problem.bounds)
    noises = [INPUT_NOISE, *range(SOURCES, SOURCES + len(problem.channels))]
    noise_low, noise_high = (b[noises] for b in bounds(problem, 1.0))  # no torque is among them
    std = np.sqrt(np.maximum(np.diag(fit.after.covariance), 0.0))
    logs = problem.logarithmic[:n]
    moved = np.where(logs, np.clip(_MOVED * std, _LEAST, _MOST), np.maximum(_MOVED * std, 1e-12))
    return Axes(
        low=np.concatenate([low, noise_low]),
        high=np.concatenate([high, noise_high]),
        difference=np.concatenate([moved, np.full(len(noises), DIFFERENCE)]),
        longest=np.concatenate([np.where(logs, _LONGEST, np.inf), np.full(len(noises), LONGEST)]),
    )


def _most_likely(fit: OutputErrorFit, at: Predictor, axes: Axes, unknowns: F64, columns: Sequence[int]) -> Found | None:
    """Noise first, then parameters and noise; None: it does not come to rest."""
    n = len(at.problem.parameter_of_column)

    def innovations(z: F64) -> tuple[F64, F64]:
        there = unknowns.copy()
        there[:n] = z[:n]
        out = at.run(there, z[n:])
        e, logs = ([part.ravel() for part in parts] for parts in (out.innovations, out.log_variance))
        return np.concatenate(e), np.concatenate(logs)

    start = np.concatenate([unknowns[:n], _first_noise(fit, axes.low[n:], axes.high[n:])])
    if not np.isfinite(deviance(innovations(start))):
        return None
    noise = list(range(n, len(start)))
    begun = fisher_scoring(innovations, start, noise, axes)
    found = fisher_scoring(innovations, begun.at, [*columns, *noise], axes)
    return found if found.converged and np.isfinite(found.value) else None


def _first_noise(fit: OutputErrorFit, low: F64, high: F64) -> F64:
    """As the fit has found it, or a share of the signals."""
    if fit.refined is not None:
        a = fit.refined.log_variance
        return np.asarray(np.clip(np.concatenate([a[[INPUT_NOISE]], a[SOURCES:]]), low, high))
    shares = np.concatenate([[_INPUT_SHARE], np.full(len(low) - 1, _SENSOR_SHARE)])
    return np.asarray(np.clip(high + 2 * np.log(shares), low, high))


def _tests(problem: Problem, out: Predictions) -> dict[str, ResidualTest]:
    """Of the innovations' whiteness."""
    parts = zip(out.innovations, out.log_variance, strict=True)
    squares = np.sum([(e * e * np.exp(v)).sum(axis=0) for e, v in parts], axis=0)
    rms = np.sqrt(squares / problem.counts)
    return innovation_tests(problem, out.innovations, rms, moving(problem), resolution(problem))


def _published(
    fit: OutputErrorFit, known: Information, found: F64, log_variance: F64, tests: dict[str, ResidualTest]
) -> OutputErrorFit:
    """The fit with these parameters: free runs from the states that suit them."""
    problem = fit.problem
    n = len(problem.parameter_of_column)
    unknowns = fit.solution.point.unknowns.copy()
    unknowns[:n] = found[:n]
    if not problem.local and (states := with_settled_states(problem, unknowns)) is not None:
        unknowns = states
    sigma = np.exp(log_variance / 2).tolist()
    noise = NoiseModel(sigma[0], dict(zip(problem.channels, sigma[1:], strict=True)), 0.0)
    return replace(republished(fit, unknowns, known), innovation=tests, noise=noise)


def _information(before: Information, found: Found, columns: Sequence[int]) -> Information:
    """What the predictions tell of these columns, the noise being unknown as well."""
    covariance = 2.0 * inverse_of_information(found.hessian)
    k = len(columns)
    values, vectors = np.linalg.eigh(covariance[:k, :k])
    root = np.zeros((len(before.names), k))
    root[list(columns)] = vectors * np.sqrt(np.maximum(values, 0.0))
    return replace(before, root=root)
