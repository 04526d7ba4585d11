"""L where the current's sensor, or the drive, filters what it shows: a filter of t_f passes for R t_f more of L, and of
what is left R takes some.

The shaft tells it apart. Its acceleration follows the torque of the current that flows, and where the shown one is
t_f late, that of i + t_f di/dt. This gives t_f by least squares, and nothing of it has to be believed: a model is
fitted to the current so put right, its current is filtered as the sensor does and must come nearer to what was shown.
"""

from __future__ import annotations

import numpy as np

from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.lag_like import Refit, moved_to, values_of
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.problem.rollout import STEP
from servo_daemon.numerics import least_squares, triangular_means, turning_over
from servo_daemon.samples import F64

#: Second differences of the angle over this, s, and at least so many samples: an encoder's steps are small in them.
_SPAN_S, _LEAST = 0.01, 4
#: A current read at the samples is up to half of one behind what flows between them, and a mechanism moves that a
#: little (of 165 captures without a filter 12 at 50 to 63 % of one).
_SAMPLES = 0.75
#: The product of both channels' sums of squares falls by more than this factor.
_CLEARLY = 2.0


def by_late_current(fit: OutputErrorFit, again: Refit) -> tuple[F64, float] | None:
    """By how much the coordinates of the free parameters may be off, in one direction, where the current is filtered:
    1 σ, shape (k,), and the filter's time constant, s. None: it is not."""
    problem = fit.problem
    if problem.plant.drive != "voltage" or problem.channels[0] != "current_A" or len(problem.channels) < 2:
        return None
    if "measurement_delay" in problem.plant.effects or "L" not in problem.free:
        return None
    segments = [s for s in problem.segments if s.recording not in problem.blocked]
    late_s = _late_s(problem, max(segments, key=lambda s: len(s.rows))) if segments else 0.0
    if late_s < _SAMPLES * problem.sample_period_s:
        return None
    values = values_of(fit)
    rest = max(values["L"] - late_s * values["R"], 0.05 * values["L"])
    other = again(problem.plant.effects, {**values, "L": rest}, late_s=late_s)
    return (moved_to(other, fit), late_s) if other is not None and _nearer(other, fit, late_s) else None


def _late_s(problem: Problem, segment: Segment) -> float:
    """t_f of J dω/dt = K (i + t_f di/dt) − friction, s; 0 where nothing of the kind shows."""
    h, n = problem.sample_period_s, len(segment.measured)
    m = max(_LEAST, round(_SPAN_S / h))
    if n < 10 * m or not segment.valid.all():
        return 0.0
    i, shown = segment.measured.T
    way = np.diff(shown) if problem.channels[1] == "position_rad" else (shown * segment.rows[:, STEP])[:-1]
    gained, friction = turning_over(way, m)
    driving = [triangular_means((i[1:] + i[:-1]) / 2.0, m), triangular_means(np.diff(i) / h, m)]
    (torque, rate, *_), _ = least_squares(np.column_stack([*driving, *friction]), gained)
    return float(rate / torque) if torque > 0.0 else 0.0


def _nearer(other: OutputErrorFit, fit: OutputErrorFit, late_s: float) -> bool:
    """Whether the current of the other fit, filtered, and its motion are clearly nearer to what was shown: by their
    likelihood, that of white noise of unknown size in each."""
    before = after = moved = stayed = 0.0
    for shown, here, right, there in zip(
        fit.problem.segments,
        fit.plain.point.linearisation.residuals,
        other.problem.segments,
        other.plain.point.linearisation.residuals,
        strict=True,
    ):
        current = shown.measured[:, 0]
        simulated = _filtered(right.measured[:, 0] - there[:, 0], late_s, fit.problem.sample_period_s, current[0])
        before += float(here[:, 0] @ here[:, 0])
        after += float(np.sum(np.where(shown.valid[:, 0], current - simulated, 0.0) ** 2))
        moved += float(there[:, 1] @ there[:, 1])
        stayed += float(here[:, 1] @ here[:, 1])
    return _CLEARLY * after * moved < before * stayed


def _filtered(values: F64, late_s: float, period_s: float, first: float) -> F64:
    """What a filter of the first order makes of values, shape (n,), that run straight from sample to sample."""
    from scipy.signal import lfilter  # late: it takes a third of a second to import

    kept = float(np.exp(-period_s / late_s))
    now = 1.0 - late_s / period_s * (1.0 - kept)
    out, _ = lfilter([now, 1.0 - kept - now], [1.0, -kept], values, zi=[first - now * values[0]])
    return np.asarray(out)
