"""A voltage that is written rows above or below the motion it drives, where no current tells the row.

A motion that begins before its voltage has no lag, and less inertia. One that waits for a row (a command that is logged
before it acts, a motion that is shown late) seems to have a slow winding. But no winding waits: of a lag the first row
shows the least, and something.
"""

from __future__ import annotations

import numpy as np

from servo_daemon.identification.output_error.discrepancy.lag_like import Refit, leaves_the_trace_of_l, values_of
from servo_daemon.identification.output_error.discrepancy.other_laws import held_of
from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.problem.rollout import INPUT, STEP
from servo_daemon.numerics import least_squares
from servo_daemon.samples import F64

#: A winding's lag, in samples, that is as good as none, and from which a search with other rows begins.
_FAST = 0.5
#: A row explains more by so much a sample (noise of the voltage by chance 0.04).
_SHARE = 0.05
#: Rows that a motion may wait, as where a current tells them (`captures/meaning/rows.py`).
_ROWS = 3
#: A row that shows less than this share of what the one that shows most does, within three standard deviations, shows
#: nothing: shaft, winding and a filter show 1 : 11 : 11 : 1 where all of them are slow (Euler–Frobenius polynomials).
_NOTHING, _SURE = 0.05, 3.0
#: Rows with the usual period, so near; and fewest of them.
_EVEN, _FEWEST = 0.2, 200


def with_other_rows(fit: OutputErrorFit, again: Refit, *, unexplained: bool) -> tuple[OutputErrorFit, int] | None:
    """The motor with the voltage brought back to the motion's rows, and by how many it is late, negative: early. None:
    it is in its row, or that does not show.

    Args:
        unexplained: whether something is left of the data that other rows could explain.
    """
    if not leaves_the_trace_of_l(fit.problem):
        return None
    clearly, found = _SHARE * float(fit.problem.counts.sum()), fit.plain.point.value
    best: tuple[OutputErrorFit, int] | None = None
    waits = _waits(fit.problem)
    if not (waits or unexplained):
        return None
    # A lag is no late voltage, which would have shortened it; and an early one makes a lag.
    way = -1 if waits or _lag(fit) > _FAST else 1
    for late in range(way * max(waits, 1), way * (_ROWS + 1), way):
        other = _with_rows(fit, again, late)
        if other is None or (-late != waits and other.solution.point.value > found - clearly):
            break
        best, found = (other, late), other.solution.point.value
    return best


def _lag(fit: OutputErrorFit) -> float:
    """The winding's, in samples."""
    values = values_of(fit)
    return values["L"] / values["R"] / fit.problem.sample_period_s


def _with_rows(fit: OutputErrorFit, again: Refit, rows_late: int) -> OutputErrorFit | None:
    problem, values = fit.problem, values_of(fit)
    begun = {**values, "L": _FAST * values["R"] * problem.sample_period_s}
    return again(problem.plant.effects, begun, held_of(fit), rows_late=rows_late)


def _waits(problem: Problem) -> int:
    """Rows in which the motion does not answer the voltage; 0 where that does not show."""
    segments = [s for s in problem.segments if s.recording not in problem.blocked]
    parts = [_steps(s, problem) for s in segments if len(s.rows) > 2 * _ROWS + 4]
    if not parts:
        return 0
    A, y = np.vstack([a for a, _ in parts]), np.concatenate([b for _, b in parts])
    if len(y) < _FEWEST:
        return 0
    found, rank = least_squares(A, y)
    if rank < A.shape[1]:
        return 0
    size, left = np.linalg.norm(A, axis=0), y - A @ found
    spread = np.sqrt(np.diag(np.linalg.inv((A / size).T @ (A / size)))) / size
    most = np.abs(found) + _SURE * spread * float(np.sqrt(left @ left / (len(y) - rank)))
    by_voltage = slice(0, _ROWS + 1)
    shows = most[by_voltage] > _NOTHING * np.max(np.abs(found[by_voltage]))
    return int(np.argmax(shows))


def _steps(segment: Segment, problem: Problem) -> tuple[F64, F64]:
    """The motion of each row after what it may answer: voltages of the row and of those before it, its own past, dry
    friction and an offset; shapes (n, m) and (n,)."""
    name = next(c for c in ("position_rad", "velocity_rad_s") if c in problem.channels)
    k = problem.channels.index(name)
    shown, h, v = segment.measured[:, k], segment.rows[:-1, STEP], segment.rows[:, INPUT]
    motion = np.diff(shown) / h if name == "position_rad" else shown[1:]
    seen = segment.valid[1:, k] & segment.valid[:-1, k]
    at = np.arange(_ROWS + 1, len(motion))
    even = np.abs(h / problem.sample_period_s - 1.0) < _EVEN
    use = np.all([(seen & even)[at - by] for by in range(_ROWS + 2)], axis=0)
    at = at[use]
    usual = float(np.sqrt(np.mean(motion[seen] ** 2))) if seen.any() else 1.0
    past = [motion[at - 1], motion[at - 2], np.tanh(motion[at - 1] / (0.1 * (usual or 1.0))), np.ones(len(at))]
    return np.column_stack([*[v[at - by] for by in range(_ROWS + 2)], *past]), motion[at]
