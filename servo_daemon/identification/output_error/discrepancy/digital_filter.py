"""The speed's filter as a program runs it, once a sample: y += a (ω − y).

Such a filter follows a step within the sample, which no continuous one does. Of the same lag, t_f = h (1/a − 1), it
leads by half a sample. A winding of which no L is seen is that fast, too, and its lag is in t_f. So where the filter is
likelier a digital one than the model's, or L is lost, t_f is known to half a sample; and L is, where no current tells
it.
"""

from __future__ import annotations

import numpy as np

from servo_daemon.identification.output_error.discrepancy.lag_like import SHARE, leaves_the_trace_of_l, values_of
from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.noise.noise import WORTH
from servo_daemon.samples import F64


def by_filter_within_a_sample(fit: OutputErrorFit) -> F64 | None:
    """By how much the coordinates of the free parameters may be off by what is faster than a sample beside the speed's
    filter: 1 σ, shape (k,). None: the model has no filter, or L is known and nothing speaks for a digital one."""
    problem, names = fit.problem, fit.problem.parameter_of_column
    if "speed_filter" not in problem.plant.effects or "t_f" not in names:
        return None
    values, half = values_of(fit), problem.sample_period_s / 2.0
    like_l = leaves_the_trace_of_l(problem)
    if fit.parameters["L"].value is not None and not like_l and not _likelier_digital(fit, values["t_f"], 2.0 * half):
        return None
    column, at = np.zeros(len(names)), names.index("t_f")
    if like_l:
        column = SHARE * min(half * values["R"] / values["L"], 1.0) * _along(fit, "L")
    column[at] = -max(abs(column[at]), SHARE * min(half / values["t_f"], 1.0))
    return column


def _along(fit: OutputErrorFit, name: str) -> F64:
    """How the coordinates of the free parameters go with one of them, by the fit's covariance, shape (k,)."""
    at, root = fit.problem.parameter_of_column.index(name), fit.after.root
    with_it = root @ root[at]
    shown = np.isfinite(with_it).all() and with_it[at] > 0.0
    return np.asarray(with_it / with_it[at] if shown else np.eye(len(with_it))[at])


def _likelier_digital(fit: OutputErrorFit, t_f: float, period_s: float) -> bool:
    problem, point, gained = fit.problem, fit.plain.point, 0.0
    channel = problem.channels.index("velocity_rad_s")
    for segment, left in zip(problem.segments, point.linearisation.residuals, strict=True):
        r = left[:, channel]
        otherwise = r - _digital_less_continuous(segment.measured[:, channel] - r, t_f, period_s)
        gained += float(r @ r - otherwise @ otherwise)
    return gained > WORTH * float(point.sigma[channel]) ** 2


def _digital_less_continuous(shown: F64, t_f: float, period_s: float) -> F64:
    """What a digital filter of this lag would show, less what a continuous one does, shape (n,)."""
    from scipy.signal import lfilter  # late: it takes a third of a second to import

    speed = shown + t_f * np.gradient(shown, period_s)
    a = period_s / (period_s + t_f)
    digital, _ = lfilter([a], [1.0, a - 1.0], speed, zi=[(1.0 - a) * shown[0]])
    return np.asarray(digital - shown)
