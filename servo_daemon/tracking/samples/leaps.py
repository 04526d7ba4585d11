"""Samples that leap and leap back: misread rather than measured, and no good in a window of the regressions.

The running filter weighs them one by one (`layout_step.py`), and what it does not believe the regressions are not told.
Before it starts nothing does that, and a window with one current at its limit bends what the filter begins with.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64

Mask = NDArray[np.bool_]


def without_leaps(tick: Stretch, input_signal: F64 | None, largest_leap: float, largest_current_leap: float) -> Stretch:
    """A tick's samples without those whose input leaps and leaps back, or whose current does so where the input does
    not leap. Of the first and last sample that is only seen from one side: a step just there is left out as well.

    Args:
        input_signal: what drives the model, shape (n,); None: it is not there.
        largest_leap, largest_current_leap: the largest that are none, as `Levels` has them.
    """
    leaps = np.zeros(len(tick.time_s), dtype=bool)
    if len(leaps) < 3:
        return tick
    moves = np.zeros(len(leaps), dtype=bool)
    if input_signal is not None:
        leaps |= _lone(input_signal, largest_leap)
        far = np.abs(input_signal[1:] - input_signal[:-1]) > largest_leap
        moves[1:] |= far
        moves[2:] |= far[:-1]  # a current may be sensed late
    if tick.current is not None and tick.current is not input_signal:
        leaps |= _lone(tick.current, largest_current_leap) & ~moves
    return replace(tick, usable=tick.usable & ~leaps) if leaps.any() else tick


def _lone(signal: F64, most: float) -> Mask:
    """Whether each sample is further than `most` from both its neighbours, to the same side; the first from the two
    after it, the last from the two before. Shape (n,)."""
    there = np.diff(signal, prepend=signal[2], append=signal[-3])
    return np.asarray((np.minimum(np.abs(there[:-1]), np.abs(there[1:])) > most) & (there[:-1] * there[1:] < 0.0))
