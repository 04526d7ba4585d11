"""L, R and J where the current's sensor, or the drive, filters what it shows: a filter of t_f passes for R t_f more of
L, and of what is left R takes some.

The shaft tells it apart. Its acceleration follows the torque of the current that flows, and where the shown one is
t_f late, that of i + t_f di/dt. This gives t_f by least squares, and nothing of it has to be believed: a model is
fitted to the current so put right, its current is filtered as the sensor does and must come nearer to what was shown.

A mean over a part of a row (an INA219 that a sketch asks) is too short for that, and makes R and J as wrong where a row
is long beside the motor's time constant. The back-EMF tells it.
"""

from __future__ import annotations

import numpy as np

from servo_daemon.identification.output_error.discrepancy.lag_like import Refit, bounded_move, moved_to, values_of
from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.problem.rollout import INPUT, STEP
from servo_daemon.numerics import least_squares, triangular_means, turning_over
from servo_daemon.samples import F64

#: Second differences of the angle over this, s, and at least so many samples: an encoder's steps are small in them.
_SPAN_S, _LEAST = 0.01, 4
#: A current read at the samples is up to half of one behind what flows between them, and a mechanism moves that a
#: little (of 165 captures without a filter 12 at 50 to 63 % of one).
SAMPLES = 0.75
#: Within a row a current is late by this share of it at the least, and by so many standard errors (without a filter
#: 0.00 to 0.02 of one is seen, of means over 0.43 to 0.85 of a row half of that).
_LEAST_SHARE, _SIGMA = 0.1, 5.0
#: The product of both channels' sums of squares falls by more than this factor.
_CLEARLY = 2.0


def by_late_current(fit: OutputErrorFit, again: Refit) -> tuple[F64, float] | None:
    """By how much the coordinates of the free parameters may be off, in one direction, where the current is filtered:
    1 σ, shape (k,), and the filter's time constant, s. None: it is not."""
    problem = fit.problem
    if problem.plant.drive != "voltage" or problem.channels[0] != "current_A" or len(problem.channels) < 2:
        return None
    if "measurement_delay" in problem.plant.effects or "L" not in problem.free or problem.plant.mean_current:
        return None  # (a mean is half a row late, and the model knows)
    segments = [s for s in problem.segments if s.recording not in problem.blocked]
    late_s = _late_s(problem, max(segments, key=lambda s: len(s.rows))) if segments else 0.0
    values = values_of(fit)
    if late_s < SAMPLES * problem.sample_period_s:
        return _within_a_sample(fit)
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


def _within_a_sample(fit: OutputErrorFit) -> tuple[F64, float] | None:
    """As `by_late_current`, by the back-EMF that a current answers: that of the speeds at both ends of its row, of
    which the earlier one counts the more the later the current is.

    It is the winding's balance alone, whatever turns with the shaft, and has an R and a K. L and J are what leaves the
    time constants. The speeds that the model makes are instruments for the measured ones, whose noise would make both
    count alike.
    """
    if fit.problem.channels[1] != "velocity_rad_s":  # an angle tells no speed of a moment
        return None
    X, Z, y = _answers(fit)
    size = np.maximum(np.linalg.norm(Z, axis=0), 1e-300)
    if len(y) <= len(size) or np.linalg.matrix_rank((Z / size).T @ (X / size)) < len(size):
        return None
    back = np.linalg.inv((Z / size).T @ (X / size)) / size[:, None]
    found = back @ ((Z / size).T @ y)
    root = back @ (Z / size).T * float(np.sqrt(np.mean((y - X @ found) ** 2)))
    earlier, later, voltage, to_come = found[:4].tolist()
    both = earlier + later
    if both >= 0.0 or abs(to_come) > _LEAST_SHARE * voltage:  # or the voltage is not held over its row
        return None
    std = float(np.linalg.norm(later * root[0] - earlier * root[1])) / both**2
    values, h = values_of(fit), fit.problem.sample_period_s
    lag = values["L"] / values["R"]
    stays = float(np.exp(-h / lag))
    late = earlier / both - (lag / h - stays / (1.0 - stays))
    if late < max(_LEAST_SHARE, _SIGMA * std):
        return None
    R, K = (1.0 - stays) / voltage / values["R"], -both / voltage / values["K"]
    moved = {"R": R, "L": R, "K": K, "J": K**2 / R}
    names = fit.problem.parameter_of_column
    return bounded_move(np.array([np.log(moved[n]) if n in moved else 0.0 for n in names])), float(h * late)


def _answers(fit: OutputErrorFit) -> tuple[F64, F64, F64]:
    """What the current at the end of a row answers, the speeds and voltages at both ends and others, shape (rows, 7);
    the same with the model's speeds; and the current, shape (rows,)."""
    here: list[F64] = []
    made: list[F64] = []
    current: list[F64] = []
    for segment, left in zip(fit.problem.segments, fit.plain.point.linearisation.residuals, strict=True):
        (i, shown), v = segment.measured.T, segment.rows[:, INPUT]
        known = segment.valid[1:].all(axis=1) & segment.valid[:-1].all(axis=1)
        others = np.column_stack([v[:-1], v[1:], i[:-1], np.ones(len(v) - 1), np.sign(v[:-1])])
        for table, speed in ((here, shown), (made, shown - left[:, 1])):
            table.append(np.column_stack([speed[:-1], speed[1:], others])[known])
        current.append(i[1:][known])
    return np.vstack(here), np.vstack(made), np.concatenate(current)


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
