"""Channels without variation: they have no noise scale, and no vote in a likelihood that balances channels by theirs.

A shaft that does not turn under a current that flows is held (the blocked-rotor test, from which R and L are known
best): ω = 0 is information, and the recording is one of the winding alone; so it is if the sensor has
noise: white, and nothing in it follows the voltage or the current. A current that never changes beside a shaft
that moves is a sensor that is not there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servo_daemon.regression.held_shaft import STILL
from servo_daemon.samples import F64, SampleBlock

#: A correlation, in units of 1/√n, and a mean, in its standard deviations, that chance makes once in 16,000 times; and
#: fewest samples that it is asked of.
_BY_CHANCE, _FEWEST = 4.0, 100


def moves(values: F64 | None) -> bool:
    """Whether a channel is there and changes."""
    return values is not None and float(np.nanmax(values) - np.nanmin(values)) > STILL


def has_held_shaft(block: SampleBlock) -> bool:
    """Whether a current flows, driven by a known voltage, and the shaft is seen to stand."""
    motion = block.position_rad if block.position_rad is not None else block.velocity_rad_s
    if motion is None or block.voltage_V is None or block.current_A is None or not moves(block.current_A):
        return False
    if not moves(motion):
        return True
    at_rest = motion is block.position_rad or abs(np.mean(motion)) < _BY_CHANCE * np.std(motion) / np.sqrt(len(motion))
    return bool(at_rest) and _is_noise(motion, (block.voltage_V, block.current_A))


def _is_noise(values: F64, causes: Sequence[F64]) -> bool:
    """Whether values, shape (n,), are white and follow none of the others, at the same sample or the one before."""
    d = values - np.mean(values)
    square = float(d @ d)
    if len(d) < _FEWEST or float(np.sum(np.square(np.diff(d)))) < square:  # of white noise it is twice as much
        return False
    return not any(_follows(d[late:], u[: len(u) - late]) for u in causes for late in (0, 1))


def _follows(values: F64, cause: F64) -> bool:
    u = cause - np.mean(cause)
    size = float(np.sqrt((values @ values) * (u @ u)))
    return abs(float(values @ u)) > _BY_CHANCE * size / math.sqrt(len(values))
