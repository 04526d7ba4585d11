"""Spikes, samples that jump and jump back: misread rather than measured, and left out of the regressions' windows.

The running filter weighs them one by one (`layout_step.py`), and what it does not believe the regressions are not told.
Before it starts nothing does that, and a window with one current at its limit biases what the filter begins with.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64

Mask = NDArray[np.bool_]


def without_spikes(tick: Stretch, input_signal: F64 | None, spike_limit: float, current_spike_limit: float) -> Stretch:
    """A tick's samples without spikes of the input, and of the current where the input does not move. The first and
    last sample have one neighbour only: a step just there is left out as well.

    Args:
        input_signal: what drives the model, shape (n,); None: it is not there.
        spike_limit, current_spike_limit: the largest that are none, as `SignalScales` has them.
    """
    spikes = np.zeros(len(tick.time_s), dtype=bool)
    if len(spikes) < 3:
        return tick
    moves = np.zeros(len(spikes), dtype=bool)
    if input_signal is not None:
        spikes |= _lone(input_signal, spike_limit)
        far = np.abs(input_signal[1:] - input_signal[:-1]) > spike_limit
        moves[1:] |= far
        moves[2:] |= far[:-1]  # a current may be sensed late
    if tick.current is not None and tick.current is not input_signal:
        spikes |= _lone(tick.current, current_spike_limit) & ~moves
    return replace(tick, usable=tick.usable & ~spikes) if spikes.any() else tick


def _lone(signal: F64, most: float) -> Mask:
    """Whether each sample is further than `most` from both its neighbours, to the same side; the first from the two
    after it, the last from the two before. Shape (n,)."""
    there = np.diff(signal, prepend=signal[2], append=signal[-3])
    return np.asarray((np.minimum(np.abs(there[:-1]), np.abs(there[1:])) > most) & (there[:-1] * there[1:] < 0.0))
