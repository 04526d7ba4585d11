"""A shaft that a brake holds, or a gear that locks itself: it stands without the current that its load asks for.

To a model without a brake dry friction holds the load there, and comes out several times too large. What is recorded
under a brake tells nothing of the motor: it counts as a pause.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servo_daemon.captures.capture.model import Capture
from servo_daemon.captures.meaning.finding import Finding
from servo_daemon.captures.meaning.windows import FEWEST, travelled
from servo_daemon.numerics import least_squares, runs_of
from servo_daemon.samples import F64

#: A shaft stands below this share of its highest speed; of a stretch so long at the least, s, without so many samples
#: at either end, in which a brake opens and closes.
_STANDS, _LASTING_S, _EDGE = 0.02, 0.2, 2
#: Windows in which current and motion are looked at, s: an encoder's steps are small in them.
_WINDOW_S = 0.05
#: So many windows on either side of one that moves do, too: a brake that opens lets the load go for a moment.
_SETTLES = 2
#: The load's current is more than so many times that of dry friction, and than what its law leaves open (rms), and than
#: half of all current while the shaft moves.
_CLEARLY = 3.0
#: Each direction has this share of the moving windows.
_EITHER_WAY = 0.15


def brake_findings(capture: Capture) -> list[Finding]:
    """The samples at which a brake holds the shaft; empty where dry friction may, or no load shows."""
    travel, i = travelled(capture), capture.current_A
    if i is None or travel is None or capture.axis != "rotary":
        return []
    h = np.diff(capture.time_s)
    m = max(2, round(_WINDOW_S / capture.sample_period_s))
    edges = np.arange(0, len(i), m)
    if len(edges) <= FEWEST:
        return []
    lasting = np.diff(capture.time_s[edges])
    speed, current = (np.add.reduceat(x, edges[:-1])[: len(lasting)] / lasting for x in (travel, i[:-1] * h))
    stands = np.abs(speed) < _STANDS * np.max(np.abs(speed))
    angle = np.concatenate([[0.0], np.cumsum(travel)])[edges]
    needed, rubs, left = _law(speed, current, (angle[1:] + angle[:-1]) / 2, np.gradient(speed) / lasting, ~stands)
    most = float(np.sqrt(np.mean(current[~stands] ** 2))) if not stands.all() else np.inf
    large = np.abs(needed) > max(_CLEARLY * rubs, _CLEARLY * left, most / 2)
    too_little = np.abs(current) < np.abs(needed) / 2 - max(rubs, left)
    at = _stretches(stands & large & too_little, edges, capture)
    if not at.any():
        return []
    pieces = len(runs_of(at))
    text = (
        f"the shaft stands {pieces} time{'s' if pieces > 1 else ''} with less current than the load takes that shows "
        f"while it moves: a brake, or a gear that locks itself. These {np.count_nonzero(at):,} of {len(at):,} samples "
        "are left out, as a pause"
    )
    return [Finding("current_A", text, "rows", at)]


def _law(speed: F64, current: F64, angle: F64, gained: F64, moves: NDArray[np.bool_]) -> tuple[F64, float, float]:
    """The load's current at every window, shape (w,), that of dry friction, and what they leave of the current where it
    moves, rms; infinite where one direction is missing or there are too few windows."""
    load = np.column_stack([np.ones_like(angle), np.sin(angle), np.cos(angle)])
    moves = np.convolve(moves, np.ones(2 * _SETTLES + 1), "same") > 2 * _SETTLES + 0.5
    forth = float(np.mean(speed[moves] > 0.0)) if moves.any() else 0.0
    if np.count_nonzero(moves) < FEWEST or not _EITHER_WAY < forth < 1.0 - _EITHER_WAY:
        return np.zeros_like(angle), np.inf, np.inf
    table = np.column_stack([load, np.sign(speed), speed, gained])
    found, _ = least_squares(table[moves], current[moves])
    left = float(np.sqrt(np.mean((current[moves] - table[moves] @ found) ** 2)))
    return load @ found[:3], abs(float(found[3])), left


def _stretches(windows: NDArray[np.bool_], edges: NDArray[np.intp], capture: Capture) -> NDArray[np.bool_]:
    """The samples of windows in a row that last long enough, without those at their ends, shape (n,)."""
    out = np.zeros(len(capture), dtype=bool)
    for first, last in runs_of(windows):
        a, b = int(edges[first]), int(edges[last])
        if capture.time_s[b] - capture.time_s[a] >= _LASTING_S:
            out[a + _EDGE * (a > 0) : b - _EDGE] = True
    return out
