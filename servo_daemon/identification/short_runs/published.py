"""A fit of free runs made again by short ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.output_error.precision.information import Information, wider
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.identification.output_error.republished import republished, uncut, with_settled_states
from servo_daemon.identification.short_runs.fit import fit_short_runs
from servo_daemon.identification.short_runs.gap import likelier
from servo_daemon.identification.short_runs.informative import RunSource, with_all_inertia
from servo_daemon.identification.short_runs.search import ShortRunFit
from servo_daemon.kalman.gaussian import coordinates_of


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
    whole = uncut(fit.problem, recordings)
    source = RunSource(whole, with_all_inertia(begin))
    short = fit_short_runs(source, begin)
    if short is None or not (np.isfinite(short.q).all() and np.isfinite(short.covariance).all()):
        return None
    names, free = whole.plant.parameter_names, fit.problem.free
    begun = coordinates_of(whole.plant.parameters, begin)
    best = begun if likelier(source, begun, short.q) else short.q
    apart = np.abs(begun - short.q)
    unknowns = fit.solution.point.unknowns.copy()
    unknowns[: len(free)] = [best[names.index(name)] for name in free]
    unknowns_there = with_settled_states(fit.problem, unknowns)
    if unknowns_there is None:
        return None
    known = wider(_information(fit, short), {k: float(apart[names.index(n)]) for k, n in enumerate(free)})
    return republished(fit, unknowns_there, known)


def _information(fit: OutputErrorFit, short: ShortRunFit) -> Information:
    """What the short runs tell of the free parameters."""
    names = fit.problem.plant.parameter_names
    order = [short.columns.index(names.index(name)) for name in fit.problem.free]
    values, vectors = np.linalg.eigh(short.covariance[np.ix_(order, order)])
    return replace(fit.after, root=np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))))
