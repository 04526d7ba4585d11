"""A fit of free runs made again by short ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.estimators.output_error import OutputErrorFit
from servo_daemon.estimators.output_error.information import Information, wider
from servo_daemon.estimators.output_error.lost_runs import settled
from servo_daemon.estimators.output_error.parameters import correlation_of, fitted_parameters
from servo_daemon.estimators.output_error.residual import residual_tests
from servo_daemon.estimators.output_error.setup import Recording, make_problem
from servo_daemon.estimators.output_error.solver import point_of
from servo_daemon.estimators.short_runs.fit import coordinates_of, fit_short_runs
from servo_daemon.estimators.short_runs.gap import likelier
from servo_daemon.estimators.short_runs.search import ShortRunFit


def by_short_runs(
    fit: OutputErrorFit, recordings: Sequence[Recording], begin: Mapping[str, float]
) -> OutputErrorFit | None:
    """The same model with the parameters that short runs have; None where they do not tell.

    Args:
        fit: in free runs of one recording, with a gap among its parameters.
        recordings: the same.
        begin: from these natural values, which another fit to runs with a searched load has come to. What is known is
            no better known than both agree on it, and the likelier of them is published.
    """
    whole = make_problem(recordings, fit.problem.plant.effects, {})
    whole = replace(whole, free=fit.problem.free, local=fit.problem.local, given=fit.problem.given)
    short = fit_short_runs(whole, begin)
    if short is None or not (np.isfinite(short.q).all() and np.isfinite(short.covariance).all()):
        return None
    problem, n = fit.problem, len(fit.problem.parameter_of_column)
    names = problem.plant.parameter_names
    begun = coordinates_of(problem, begin)
    best = begun if likelier(whole, begun, short.q) else short.q
    apart = np.abs(begun - short.q)
    unknowns = fit.solution.point.unknowns.copy()
    unknowns[:n] = [best[names.index(name)] for name in problem.free]
    given = dict(problem.given) | dict(zip(problem.free, unknowns[:n].tolist(), strict=True))
    states = settled(replace(problem, free=(), given=given))
    if states is None:
        return None
    unknowns[n:] = states.point.unknowns
    point = point_of(problem, unknowns, problem.linearise(unknowns), fit.solution.point.weights)
    solution = replace(fit.solution, point=point)
    known = wider(_information(fit, short), {k: float(apart[names.index(n)]) for k, n in enumerate(problem.free)})
    nominal = {k: p.value for k, p in fit.parameters.items() if p.status == "undetermined" and p.value is not None}
    fixed = {k: p.value for k, p in fit.parameters.items() if p.status == "fixed" and p.value is not None}
    parameters, offsets = fitted_parameters(problem, solution, known, nominal, fixed)
    return replace(
        fit,
        solution=solution,
        parameters=parameters,
        offsets=offsets,
        correlation=correlation_of(known, problem.n_shared),
        after=known,
        residual=residual_tests(problem, point),
    )


def _information(fit: OutputErrorFit, short: ShortRunFit) -> Information:
    """What the short runs tell of the free parameters."""
    names = fit.problem.plant.parameter_names
    order = [short.columns.index(names.index(name)) for name in fit.problem.free]
    values, vectors = np.linalg.eigh(short.covariance[np.ix_(order, order)])
    return replace(fit.after, root=np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))))
