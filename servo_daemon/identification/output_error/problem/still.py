"""Channels without variation: they have no noise scale, and no vote in a likelihood that balances channels by theirs.

A shaft that does not turn under a current that flows is held (the blocked-rotor test, from which R and L are known
best): ω = 0 is information, and the recording is one of the winding alone; so it is if the sensor has
noise: white, and nothing in it follows the voltage or the current. A current that never changes beside a shaft
that moves is a sensor that is not there.
"""

from __future__ import annotations

import numpy as np

from servo_daemon.regression.held_shaft import STILL, NoiseAlone
from servo_daemon.samples import F64, SampleBlock


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
    noise = NoiseAlone()
    noise.take(motion - motion[0] if motion is block.position_rad else motion, (block.voltage_V, block.current_A))
    return noise.holds(about_zero=motion is not block.position_rad)
