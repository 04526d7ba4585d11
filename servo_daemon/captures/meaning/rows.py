"""A voltage that is written some rows above or below those of the other columns.

Loggers write the command that they are about to send beside what they have just measured, or the one before. Over one
row, with the voltage held, the winding goes from one current to the next by

    i[k+1] = φ i[k] + (1 − φ)/R (v[k] − K ω),      φ = exp(−R h/L),

whatever L is and whatever is on the shaft. The voltage's row is the one that leaves least of it, and where the columns
are rows apart all others leave several times as much. A lag of the drive or a filter of the current spreads over rows:
then none stands out, or a current that follows its two last values leaves less.

Without a current a voltage that is early cannot be told from a motion that is shown late. One that is late can: the
shaft answers a voltage before it is there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servo_daemon.captures.capture.model import Capture
from servo_daemon.captures.meaning.finding import Finding, mend
from servo_daemon.captures.meaning.windows import travelled, window_length
from servo_daemon.numerics import least_squares, squares_left, triangular_means, turning_over
from servo_daemon.samples import F64

#: Rows either way that are tried, and one more whose neighbour tells whether it is the best.
_ROWS = 3
#: A row stands out if it leaves less than this share (sum of squares) of what each of its neighbours leaves: half of a
#: row between them is four times as much. (At 50 Hz, where a motor turns within a row, 0.46 is seen of the right one.)
_CLEARLY = 0.25
#: Two rows leave alike up to this factor: what the winding's lag makes of one.
_ALIKE = 1.25
#: Rows with the usual period, so near; and fewest of them.
_EVEN, _FEWEST, _MOST = 0.2, 200, 20_000
#: Nothing is told by what is this small beside the whole: rounding.
_ROUNDING = 1e-9


def row_findings(capture: Capture) -> list[Finding]:
    """A voltage some rows away from the motion, and from the current where there is one; empty where it is in its row,
    or nothing shows."""
    v, i, travel = capture.voltage_V, capture.current_A, travelled(capture)
    if v is None or travel is None or capture.meaning().measures_voltage:
        return []
    if i is None:
        rows, others = _late_for_motion(capture.time_s[:_MOST], v[:_MOST], travel[: _MOST - 1]), "the motion fits"
    else:
        winding, others = _Winding.of(capture, v, i, travel), "current and motion fit"
        rows = 0 if winding is None else winding.late()
        m = min(window_length(capture.time_s), len(v) // 20)
        if rows < 0 and _of_current(rows, i[:_MOST], travel[: _MOST - 1], m):
            return []  # which is late: an effect, `measurement_delay`
    if not rows:
        return []
    text = (
        f"column voltage_V is written {rows_away(rows)}: {others} it several times better so (a logger that writes its "
        f"next command beside what it measured, or its last one); it is left out. "
        f"{mend(capture, 'voltage_V', {'rows_late': rows})}"
    )
    if rows == 1:
        text += (
            "; or, of a drive that measures its voltage, above the header the lines  # voltage: mean  # current: mean  "
            "(over the time since the row before; of one moment: instant)"
        )
    return [Finding("voltage_V", text, "column")]


def rows_away(rows: int) -> str:
    """In words."""
    return f"{abs(rows)} row{'s' if abs(rows) > 1 else ''} {'late' if rows > 0 else 'early'}"


def _late_for_motion(time_s: F64, v: F64, travel: F64) -> int:
    """By how many rows at least a voltage is late, where the speed of a row follows, beside its own past, voltages of
    rows to come; else 0. (A control loop's voltage follows the speed, too, but against it.)"""
    h = np.diff(time_s)
    k = np.arange(_ROWS, len(h) - _ROWS - 1)
    k = k[np.abs(h[k] / np.median(h) - 1.0) < _EVEN]
    if len(k) < _FEWEST:
        return 0
    w = travel / h
    size = float(np.sqrt(np.mean(w**2))) or 1.0
    past = [w[k - 1], w[k - 2], np.tanh(w[k - 1] / (0.1 * size)), np.ones(len(k))]

    def followed(rows: int) -> F64:
        return np.column_stack([v[k + rows], v[k + rows - 1], v[k + rows - 2], *past])

    leaves = [squares_left(followed(rows), w[k]) for rows in range(_ROWS + 1)]
    if leaves[1] > _CLEARLY * leaves[0] or leaves[0] < _ROUNDING * len(k) * size**2:
        return 0
    rows = next(rows for rows, left in enumerate(leaves) if left < _ALIKE * min(leaves))
    found, _ = least_squares(followed(rows), w[k])
    return rows if found[0] > 0.0 else 0


class _Winding:
    """The winding's steps from row to row, shapes (n,), of n rows that have usual periods all around."""

    def __init__(self, k: NDArray[np.intp], v: F64, i: F64, speed: F64) -> None:
        self._k, self._v, self._i, self._speed = k, v, i, speed
        size = float(np.sqrt(np.mean(i**2))) or 1.0
        brushes = np.tanh((i[k] + i[k + 1]) / (0.1 * size))
        self._columns = [i[k], np.ones(len(k)), brushes]

    @classmethod
    def of(cls, capture: Capture, v: F64, i: F64, travel: F64) -> _Winding | None:
        """None: there are too few even rows."""
        n = min(len(v), _MOST)
        h = np.diff(capture.time_s[:n])
        k = np.arange(_ROWS + 3, n - _ROWS - 4)
        k = k[np.abs(h[k] / np.median(h) - 1.0) < _EVEN]
        return None if len(k) < _FEWEST else cls(k, v[:n], i[:n], travel[: n - 1] / h)

    def late(self) -> int:
        """By how many rows the voltage is late; negative: early; 0: it is in its row, or that does not show."""
        speed = [self._speed[self._k + by] for by in (-1, 0, 1)]
        left = {rows: self._left(rows, speed) for rows in range(-_ROWS - 1, _ROWS + 2)}
        best = min(left, key=lambda rows: left[rows])
        if best == 0 or abs(best) > _ROWS:
            return 0
        beside = min(left[best - 1], left[best + 1])
        if left[best] > _CLEARLY * beside or beside < _ROUNDING * len(self._k) * float(np.var(self._i)):
            return 0
        lag = best < 0 and left[best] > _CLEARLY * self._left(0, [*speed, self._i[self._k - 1]])
        return 0 if lag else best

    def _left(self, rows: int, more: list[F64]) -> float:
        """Sum of squares, A², with the voltage of so many rows later and more columns, shape (n,) each."""
        columns = [*self._columns, self._v[self._k + rows], *more]
        return squares_left(np.column_stack(columns), self._i[self._k + 1])


def _of_current(rows: int, i: F64, travel: F64, m: int) -> bool:
    """Whether the shaft, too, goes with a current so many rows early, and the current alone is apart from the others.

    The angle's second difference over m rows either way is a mean of the accelerations between, and of the torques.

    Args:
        i: shape (n,).
        travel: shape (n − 1,).
    """
    second, shaft = turning_over(travel, m)
    # Over one row a slow winding's current is that of its middle, a fast one's that of its end.
    between = [triangular_means(current, m) for current in (0.5 * (i[1:] + i[:-1]), i[1:])]
    use = slice(abs(rows), len(second) - abs(rows))
    friction = [one[use] for one in shaft]

    def left(by: int) -> float:
        moved = slice(use.start - by, use.stop - by)
        return min(squares_left(np.column_stack([c[moved], *friction]), second[use]) for c in between)

    return left(rows) < left(0)
