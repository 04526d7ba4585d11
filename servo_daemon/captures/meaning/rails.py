"""A current beyond its sensor: the reading stands at the range's end while voltage and motion need more."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servo_daemon.captures.capture.model import Capture
from servo_daemon.captures.meaning.finding import Finding
from servo_daemon.captures.meaning.windows import FEWEST, Windows, left, travelled

#: Windows, s, and at least so many intervals: shorter than a reading stands at its end.
_WINDOW_S, _LEAST = 0.005, 2
#: Fewest windows within the end's readings, and by which share the balance there needs more (its own error without
#: brushes: 3 %, `plausible._STATIC`).
_WITHIN, _MORE = 5, 0.05


def rail_findings(capture: Capture) -> list[Finding]:
    """The samples whose current stands at an end of its range though v = R i + K ω needs more; empty where a drive
    holds the current there, for then the balance closes."""
    v, i, travel = capture.voltage_V, capture.current_A, travelled(capture)
    if v is None or i is None or travel is None or float(np.ptp(i)) == 0.0:
        return []
    m = max(_LEAST, round(_WINDOW_S / capture.sample_period_s))
    windows = Windows.of(capture.time_s, v, travel, m)
    ends = [(i == end, end, side) for end, side in ((float(i.max()), 1.0), (float(i.min()), -1.0))]
    inside = _shares(ends[0][0] | ends[1][0], windows) == 0.0
    if np.count_nonzero(inside) < FEWEST:
        return []
    columns = windows.columns(capture.time_s, i)
    (R, _, K), _ = left(columns[inside], windows.voltage[inside])
    if R <= 0.0:
        return []
    needed = (windows.voltage - K * columns[:, 2]) / R
    clipped = np.zeros(len(i), dtype=bool)
    for at, end, side in ends:
        whole = _shares(at, windows) == 1.0
        if np.count_nonzero(whole) >= _WITHIN and np.median(side * (needed[whole] - end)) > _MORE * abs(end):
            clipped |= at
    if not clipped.any():
        return []
    shown = " and ".join(f"{end:.4g}" for at, end, _ in ends if (clipped & at).any())
    text = (
        f"column current_A stands at {shown} A in {np.count_nonzero(clipped):,} of {len(i):,} samples, where voltage "
        "and motion need more: the end of its sensor's range. There it counts as not measured. "
        "mend: a sensor or a gain for a larger range, or less voltage"
    )
    return [Finding("current_A", text, "samples", clipped)]


def _shares(at: NDArray[np.bool_], windows: Windows) -> NDArray[np.float64]:
    """Of each window's samples, both ends included, those at these places."""
    total = np.concatenate([[0], np.cumsum(at)])
    first, last = windows.edges[:-1], windows.edges[1:] + 1
    return np.asarray((total[last] - total[first]) / (last - first))
