"""The drive's temperature among what is published: it follows no model and is shown as it was measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servo_daemon.published.snapshot import Estimate
from servo_daemon.samples import SampleBlock


def last_temperature(block: SampleBlock, before: float | None) -> float | None:
    """The last finite temperature of a block, °C; without one that from before, as long as the channel is there."""
    if block.temperature_C is None:
        return None
    known = block.temperature_C[np.isfinite(block.temperature_C)]
    return float(known[-1]) if len(known) else before


def with_temperature(estimate: Estimate, temperature_C: float | None) -> Estimate:
    """With the drive's temperature in its state; where none is measured as it is."""
    if temperature_C is None or estimate.state.get("temperature_C") == temperature_C:
        return estimate
    return replace(estimate, state={**estimate.state, "temperature_C": temperature_C})
