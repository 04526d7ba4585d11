"""A fit made again with parameters that something else than its free runs has found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from servo_daemon.identification.output_error.diverged_segments import settled
from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.noise.residual import residual_tests
from servo_daemon.identification.output_error.precision.information import Information
from servo_daemon.identification.output_error.precision.parameters import correlation_of, fitted_parameters
from servo_daemon.identification.output_error.problem.linearisation import linearise
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.setup import Recording, make_problem
from servo_daemon.identification.output_error.solver.solver import point_of
from servo_daemon.samples import F64


def uncut(problem: Problem, recordings: Sequence[Recording]) -> Problem:
    """The same model and free parameters over as few segments as the recordings allow."""
    whole = make_problem(recordings, problem.plant.effects, {})
    return replace(whole, free=problem.free, local=problem.local, given=problem.given)


def with_settled_states(problem: Problem, unknowns: F64) -> F64 | None:
    """The unknowns with the initial states that suit these parameters; None: they cannot be found.

    Args:
        problem: without offsets that every recording has for itself.
    """
    n = len(problem.parameter_of_column)
    given = dict(problem.given) | dict(zip(problem.parameter_of_column, unknowns[:n].tolist(), strict=True))
    states = settled(replace(problem, free=(), given=given))
    if states is None:
        return None
    out = unknowns.copy()
    out[n:] = states.point.unknowns
    return out


def republished(fit: OutputErrorFit, unknowns: F64, known: Information) -> OutputErrorFit:
    """The fit at these unknowns, of which so much is known: what it leaves is free runs'."""
    problem = fit.problem
    point = point_of(problem, unknowns, linearise(problem, unknowns), fit.solution.point.weights)
    solution = replace(fit.solution, point=point)
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
