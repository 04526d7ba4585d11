"""What a model lacks, in the standard deviations of what it has.

Noise averages out, a misfit does not. What is left of the data and is no noise shows how large the model's error is,
and what of it lay along a parameter's sensitivity the parameter has taken: by Cauchy and Schwarz no more than

    |δq| ≤ sqrt(S) (H⁻¹)^½,      S = Σ ε² of the misfit, H the information, both in units of the residuals' σ,

if all of it did. S is what the residuals' own past and the input tell of them, n ρ² of each channel for their largest
correlation ρ. (The spectrum's sandwich takes a misfit for noise that would come out otherwise another time; but the
same motion has the same dry friction.)

A channel of which the model explains nothing says that it is a model of something else: then nothing has a value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from servo_daemon.identification.output_error.discrepancy.digital_filter import by_filter_within_a_sample
from servo_daemon.identification.output_error.discrepancy.lag_like import (
    SHARE,
    Refit,
    bounded_move,
    by_other_lags,
    is_cut_off,
    moved_to,
    values_of,
    with_more_inductance,
)
from servo_daemon.identification.output_error.discrepancy.late_current import by_late_current
from servo_daemon.identification.output_error.discrepancy.mean_current import by_mean_current
from servo_daemon.identification.output_error.discrepancy.other_laws import (
    by_friction_one_way,
    by_unheld_voltage,
    with_another_law,
)
from servo_daemon.identification.output_error.discrepancy.voltage_rows import with_other_rows
from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.noise.noise import WORTH, resolution
from servo_daemon.identification.output_error.noise.residual import ResidualTest, innovation_tests
from servo_daemon.identification.output_error.noise.whitening import moving
from servo_daemon.identification.output_error.precision.combinations import (
    answer_between,
    determined_combinations,
    wider_answer,
)
from servo_daemon.identification.output_error.precision.information import information
from servo_daemon.identification.output_error.precision.parameters import FittedParameter, at_bounds, correlation_of
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.samples import F64

#: Share of a misfit's square that lies along a parameter. Of the linear motor fitted to 90 captures of three motors
#: with dry friction, weight, brushes, cogging, drag, a late or an offset sensor in them, 2 of 213 values of R, K and J
#: were off by more than 4 of the standard deviations that this makes and 5 %; by the sandwich's alone one in six.
_ALONG = 0.16
#: A residual of this share of the signal's spread is no simulation of it.
NOTHING = 0.7


def unexplained(fit: OutputErrorFit) -> tuple[str, ...]:
    """Channels that move and of which the model explains next to nothing."""
    spread = zip(fit.problem.channels, fit.problem.spread.tolist(), strict=True)
    return tuple(name for name, size in spread if fit.residual[name].rmse > NOTHING * size > 0.0)


def with_misfit(fit: OutputErrorFit, scale: F64, again: Refit) -> OutputErrorFit:
    """The fit with what its model lacks in the standard deviations, what its B, R and L may be of what
    follows other laws; without values where it explains nothing.

    Args:
        scale: as for `information`.
        again: fits another model to the same recordings.
    """
    if unexplained(fit):
        parameters = {n: p if p.status == "fixed" else _lost(p) for n, p in fit.parameters.items()}
        offsets = tuple({n: _lost(p) for n, p in each.items()} for each in fit.offsets)
        return replace(fit, parameters=parameters, offsets=offsets, combinations=(), answer=None, correlation={})
    problem, square = fit.problem, _square(fit)
    likelier = None if square else _likelier(fit)
    names = problem.parameter_of_column
    inside, lag = _discrepancy(fit, scale, square, likelier), by_other_lags(fit, again)
    law, moved = _others(fit, again, square, likelier)
    far = [] if moved is None else [moved[0]]
    if law is not None and is_cut_off(moved_to(law, fit)):
        far.append(law)
        law = None
    means = by_mean_current(fit, again) if square else None
    filtered = by_late_current(fit, again) if square and means is None else None
    unheld = by_unheld_voltage(fit, again) if square else None
    moves = [moved_to(other, fit) for other in (law, means) if other is not None]
    moves += [] if filtered is None else [filtered[0]]
    moves += [] if unheld is None else [unheld]
    inside = np.column_stack([inside, *moves])
    seen, slower = inside if lag is None else np.column_stack([inside, lag]), with_more_inductance(fit, again)
    added = seen if slower is None else np.column_stack([seen, SHARE * moved_to(slower, fit)])
    added = np.column_stack([added, *(moved_to(other, fit) for other in far)])
    # (Not in the answer to the voltage: to that step it is what was seen, whatever rubs.)
    friction = by_friction_one_way(fit, again)
    added = added if friction is None else np.column_stack([added, friction])
    if not names or not (added.size or likelier is not None):
        return fit
    parameters = dict(fit.parameters)
    for k, name in enumerate(names[: problem.n_shared]):
        std = float(np.linalg.norm(added[k]))
        parameters[name] = _wider(parameters[name], std, logarithm=bool(problem.logarithmic[k]))
    lost = np.array([parameters[n].status == "undetermined" for n in names], dtype=bool)
    root = np.hstack([fit.after.root, added])
    after = replace(fit.after, root=root, undetermined=fit.after.undetermined | lost)
    at_end, bounded = problem.coordinates(fit.solution.point.unknowns, 0), at_bounds(problem, fit.solution)
    # The lag is all in the answer of a motor that an encoder shows; the sensor of a speed has one of its own.
    more = seen if "velocity_rad_s" in problem.channels else inside
    answer = wider_answer(fit.answer, problem.plant, at_end, (names, scale), more) if more.size else fit.answer
    if likelier is not None:
        there = natural_values(problem.plant.parameters, problem.coordinates(likelier, 0))
        answer = answer_between(answer, values_of(fit), there)
    if slower is not None:
        answer = answer_between(answer, values_of(fit), values_of(slower), SHARE)
    for other in far:  # (of which the coordinates' moves, cut off or large, do not give it)
        answer = answer_between(answer, values_of(fit), values_of(other))
    return replace(
        fit,
        parameters=parameters,
        after=after,
        correlation=correlation_of(after, problem.n_shared),
        answer=answer,
        combinations=determined_combinations(problem.plant, at_end, answer, after, scale, bounded),
        current_late_s=None if filtered is None else filtered[1],
        current_is_mean=means is not None,
        voltage_rows_late=0 if moved is None else moved[1],
    )


def _others(
    fit: OutputErrorFit, again: Refit, square: float, likelier: F64 | None
) -> tuple[OutputErrorFit | None, tuple[OutputErrorFit, int] | None]:
    """The motor with another law, and beside that with the voltage of other rows (`with_other_rows`), which explain
    more."""
    law = None
    # Noise that enters the motor passes for dry friction and the other way round; drag explains it by chance.
    if square or likelier is not None:
        law = with_another_law(fit, again, dry=not square)
    return law, with_other_rows(law or fit, again, unexplained=square > 0.0)


def _discrepancy(fit: OutputErrorFit, scale: F64, square: float, likelier: F64 | None) -> F64:
    """Root of what comes on top of the coordinates' covariance, but for other lags and laws, shape (k, ·)."""
    k = len(fit.problem.parameter_of_column)
    parts = [np.zeros((k, 0))]
    if square:
        parts.append(math.sqrt(_ALONG * square) * information(fit.problem, fit.solution.point, scale).root)
    fast = by_filter_within_a_sample(fit)
    parts += [] if fast is None else [fast[:, None]]
    # Along a null direction it says nothing how far the two estimates are apart.
    if not square and likelier is not None and not fit.null_directions:
        parts.append(bounded_move(likelier[:k] - fit.solution.point.unknowns[:k])[:, None])
    return np.hstack(parts)


def _likelier(fit: OutputErrorFit) -> F64 | None:
    """The unknowns that are likeliest with noise that enters the motor, where such noise explains what is left but is
    not known to be all of it; None: there is no such estimate.

    Plain output error is the safer one of the two, and where that noise adds up over a long run it may be far off.
    """
    tried = fit.refined
    return None if fit.noise is not None or fit.white or tried is None else tried.point.unknowns


def _lost(p: FittedParameter) -> FittedParameter:
    return replace(p, value=None, std=None, status="undetermined")


def _wider(p: FittedParameter, coordinate_std: float, *, logarithm: bool) -> FittedParameter:
    """With so much added; undetermined where a logarithm is then unknown to a factor of e."""
    if p.value is None or p.std is None:
        return p
    std = math.hypot(p.std, coordinate_std * (p.value if logarithm else 1.0))
    return _lost(p) if logarithm and std > p.value else replace(p, std=std)


def _square(fit: OutputErrorFit) -> float:
    """S; 0 where noise explains what is left, of the voltage's too. Of a current's or torque's noise, which adds up in
    a free run, the residuals look the same, and it moves the parameters as much."""
    problem, tried = fit.problem, fit.refined
    if fit.noise is not None or fit.white:
        return 0.0
    if tried is not None:
        innovations = tried.whitened.linearisation.residuals
        tests = innovation_tests(problem, innovations, tried.innovation_rms, moving(problem), resolution(problem))
        torque = "current_A" in problem.channels and tried.torque_gain > WORTH
        if not torque and all(t.white for t in tests.values()):
            return 0.0
    return _predictable(fit.residual, dict(zip(problem.channels, problem.counts.tolist(), strict=True)))


def _predictable(tests: Mapping[str, ResidualTest], counts: Mapping[str, float]) -> float:
    """Σ of squares, in units of the residuals' variance, that their own past and the input tell."""
    return sum(
        counts[name] * max(abs(t.autocorrelation), abs(t.input_correlation)) ** 2
        for name, t in tests.items()
        if not t.white
    )
