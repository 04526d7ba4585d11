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
from dataclasses import dataclass, replace

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
    VoltageAnswer,
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
    square = _square(fit)
    likelier = None if square else _likelier(fit)
    rivals = _rivals(fit, again, square, likelier)
    added = _added(fit, rivals, _discrepancy(fit, scale, square, likelier))
    if not fit.problem.parameter_of_column or not (added.root.size or likelier is not None):
        return fit
    return _widened(fit, scale, added, rivals)


@dataclass(frozen=True)
class _Rivals:
    """What else may have made the recordings; None: they speak against it.

    Attributes:
        law: the motor with another law.
        far: motors so far away that the coordinates' moves do not give the answer to the voltage.
        rows_late: rows by which the voltage is late in one of these; 0: in none.
        likelier: unknowns with noise that enters the motor.
        mean_current: each current is the mean since the one before.
        late_current: how far a late current moves the coordinates, shape (k,), and how late it is, s.
        unheld_voltage, lag, friction: how far a voltage that is not held, other lags, and friction where the motor
            turns one way only, move them, shape (k,).
        slower: the motor with more inductance.
    """

    law: OutputErrorFit | None
    far: tuple[OutputErrorFit, ...]
    rows_late: int
    likelier: F64 | None
    mean_current: OutputErrorFit | None
    late_current: tuple[F64, float] | None
    unheld_voltage: F64 | None
    lag: F64 | None
    slower: OutputErrorFit | None
    friction: F64 | None


def _rivals(fit: OutputErrorFit, again: Refit, square: float, likelier: F64 | None) -> _Rivals:
    law, moved = _others(fit, again, square, likelier)
    far = [] if moved is None else [moved[0]]
    if law is not None and is_cut_off(moved_to(law, fit)):
        far.append(law)
        law = None
    means = by_mean_current(fit, again) if square else None
    return _Rivals(
        law=law,
        far=tuple(far),
        rows_late=0 if moved is None else moved[1],
        likelier=likelier,
        mean_current=means,
        late_current=by_late_current(fit, again) if square and means is None else None,
        unheld_voltage=by_unheld_voltage(fit, again) if square else None,
        lag=by_other_lags(fit, again),
        slower=with_more_inductance(fit, again),
        friction=by_friction_one_way(fit, again),
    )


@dataclass(frozen=True)
class _Added:
    """What comes on top of the fit's covariance.

    Attributes:
        root: of the coordinates' covariance, shape (k, ·).
        of_answer: what of it makes the answer to the voltage less known, too.
    """

    root: F64
    of_answer: F64


def _added(fit: OutputErrorFit, rivals: _Rivals, discrepancy: F64) -> _Added:
    moves = [moved_to(other, fit) for other in (rivals.law, rivals.mean_current) if other is not None]
    moves += [] if rivals.late_current is None else [rivals.late_current[0]]
    moves += [] if rivals.unheld_voltage is None else [rivals.unheld_voltage]
    inside = np.column_stack([discrepancy, *moves])
    seen = inside if rivals.lag is None else np.column_stack([inside, rivals.lag])
    root = seen if rivals.slower is None else np.column_stack([seen, SHARE * moved_to(rivals.slower, fit)])
    root = np.column_stack([root, *(moved_to(other, fit) for other in rivals.far)])
    # (Not in the answer to the voltage: to that step it is what was seen, whatever rubs.)
    root = root if rivals.friction is None else np.column_stack([root, rivals.friction])
    # The lag is all in the answer of a motor that an encoder shows; the sensor of a speed has one of its own.
    return _Added(root, seen if "velocity_rad_s" in fit.problem.channels else inside)


def _widened(fit: OutputErrorFit, scale: F64, added: _Added, rivals: _Rivals) -> OutputErrorFit:
    problem, names, parameters = fit.problem, fit.problem.parameter_of_column, dict(fit.parameters)
    for k, name in enumerate(names[: problem.n_shared]):
        std = float(np.linalg.norm(added.root[k]))
        parameters[name] = _wider(parameters[name], std, logarithm=bool(problem.logarithmic[k]))
    lost = np.array([parameters[n].status == "undetermined" for n in names], dtype=bool)
    root = np.hstack([fit.after.root, added.root])
    after = replace(fit.after, root=root, undetermined=fit.after.undetermined | lost)
    at_end, bounded = problem.coordinates(fit.solution.point.unknowns, 0), at_bounds(problem, fit.solution)
    answer = _wider_answer(fit, scale, added, rivals)
    return replace(
        fit,
        parameters=parameters,
        after=after,
        correlation=correlation_of(after, problem.n_shared),
        answer=answer,
        combinations=determined_combinations(problem.plant, at_end, answer, after, scale, bounded),
        current_late_s=None if rivals.late_current is None else rivals.late_current[1],
        current_is_mean=rivals.mean_current is not None,
        voltage_rows_late=rivals.rows_late,
    )


def _wider_answer(fit: OutputErrorFit, scale: F64, added: _Added, rivals: _Rivals) -> VoltageAnswer | None:
    problem, answer = fit.problem, fit.answer
    if added.of_answer.size:
        at_end = problem.coordinates(fit.solution.point.unknowns, 0)
        answer = wider_answer(answer, problem.plant, at_end, (problem.parameter_of_column, scale), added.of_answer)
    own = values_of(fit)
    if rivals.likelier is not None:
        there = natural_values(problem.plant.parameters, problem.coordinates(rivals.likelier, 0))
        answer = answer_between(answer, own, there)
    if rivals.slower is not None:
        answer = answer_between(answer, own, values_of(rivals.slower), SHARE)
    for other in rivals.far:  # (of which the coordinates' moves do not give it)
        answer = answer_between(answer, own, values_of(other))
    return answer


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
