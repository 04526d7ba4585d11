"""A current that is shown as its mean over the row before (a converter that averages, a program's means), where the fit
takes it for its value at the row: it comes half a row late, and a winding that settles within a row seems slower.

Where what is left of the current goes with the difference of the two, the model is fitted once more with means. Nothing
of that has to be believed: they must leave nothing of the current but noise.
"""

from __future__ import annotations

import numpy as np

from servo_daemon.identification.output_error.discrepancy.lag_like import Refit, values_of
from servo_daemon.identification.output_error.discrepancy.other_laws import held_of
from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.numerics import least_squares
from servo_daemon.samples import F64

#: Share of what is left of the current that must go with the difference, beyond what the parameters could take.
_SHARE = 0.05


def by_mean_current(fit: OutputErrorFit, again: Refit) -> OutputErrorFit | None:
    """The motor whose current is shown as means over the rows; None: it is not."""
    problem = fit.problem
    if problem.plant.drive != "voltage" or "current_A" not in problem.channels or problem.plant.mean_current:
        return None
    if not _goes_with_the_mean(fit, problem.channels.index("current_A")):
        return None
    other = again(problem.plant.effects, values_of(fit), held_of(fit), mean_current=True)
    if other is None or not other.problem.plant.mean_current or not other.residual["current_A"].white:
        return None
    return other


def _goes_with_the_mean(fit: OutputErrorFit, channel: int) -> bool:
    left, parts, width = [], [], fit.problem.n_shared
    point = fit.plain.point.linearisation
    for segment, residuals, slopes in zip(fit.problem.segments, point.residuals, point.jacobian, strict=True):
        shown = segment.measured[:, channel] - residuals[:, channel]
        difference = np.concatenate([[0.0], (shown[:-1] - shown[1:]) / 2.0])
        use = segment.valid[:, channel] & np.roll(segment.valid[:, channel], 1)
        use[0] = False
        left.append(residuals[use, channel])
        parts.append(np.column_stack([difference, slopes[:, channel, :width]])[use])
    r, table = np.concatenate(left), np.vstack(parts)
    without, with_it = _rest(table[:, 1:], r), _rest(table, r)
    return bool(with_it < (1.0 - _SHARE) * without)


def _rest(columns: F64, values: F64) -> float:
    """Sum of squares that the columns leave."""
    found, _ = least_squares(columns, values)
    rest = values - columns @ found
    return float(rest @ rest)
