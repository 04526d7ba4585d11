"""Faults of instruments, put into a recording after it was made: the motor and its controller know nothing of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tests.recovery.generator import Motor, Recording, stream


@dataclass(frozen=True, slots=True)
class Where:
    """The motor, the first sample that may be wrong, and the seed of what is drawn."""

    motor: Motor
    begin: int
    seed: int


Fault = Callable[[Recording, Where], Recording]

#: Mean distance of isolated spikes, s.
SPIKE_EVERY_S = 2.0


def frozen_current(duration_s: float | None) -> Fault:
    """The current keeps its last value; None: for good."""

    def fault(recording: Recording, where: Where) -> Recording:
        end = None if duration_s is None else _end(recording, where.begin, duration_s)
        current = recording.current_A.copy()
        current[where.begin : end] = current[where.begin]
        return replace(recording, current_A=current)

    return fault


def no_voltage(duration_s: float) -> Fault:
    """The drive reports no voltage although it applies one."""

    def fault(recording: Recording, where: Where) -> Recording:
        voltage = recording.voltage_V.copy()
        voltage[where.begin : _end(recording, where.begin, duration_s)] = 0.0
        return replace(recording, voltage_V=voltage)

    return fault


def spikes(channel: str) -> Fault:
    """Single samples of "voltage_V" or "current_A" at plus or minus the supply or the current limit."""

    def fault(recording: Recording, where: Where) -> Recording:
        rng = stream(where.seed, f"spikes {channel}")
        values = getattr(recording, channel).copy()
        period = float(np.median(np.diff(recording.time_s)))
        hit = where.begin + np.flatnonzero(rng.uniform(size=len(values) - where.begin) < period / SPIKE_EVERY_S)
        size = where.motor.supply_V if channel == "voltage_V" else where.motor.current_limit_A
        values[hit] = size * rng.choice([-1.0, 1.0], size=len(hit))
        return replace(recording, **{channel: values})

    return fault


def slip(counts: int) -> Fault:
    """The encoder's disc slips on the shaft by so many counts, between two samples."""

    def fault(recording: Recording, where: Where) -> Recording:
        position = recording.position_rad.copy()
        position[where.begin :] += counts * 2 * np.pi / where.motor.counts_per_rev
        return replace(recording, position_rad=position)

    return fault


def current_offset(share: float) -> Fault:
    """The current sensor shows this share of the rated current too much."""

    def fault(recording: Recording, where: Where) -> Recording:
        current = recording.current_A.copy()
        current[where.begin :] += share * where.motor.rated_current_A
        return replace(recording, current_A=current)

    return fault


def missing(share: float, run: int) -> Fault:
    """This share of the samples never arrives, in runs of this many on average (geometric; 1: singly)."""

    def fault(recording: Recording, where: Where) -> Recording:
        rng, n = stream(where.seed, "missing"), len(recording.time_s)
        kept = np.ones(n, dtype=bool)
        between = run * (1 - share) / share
        k = where.begin + int(rng.geometric(1 / between))
        while k < n:
            lost = int(rng.geometric(1 / run))
            kept[k : k + lost] = False
            k += lost + int(rng.geometric(1 / between))
        channels = ("time_s", "voltage_V", "current_A", "position_rad")
        return replace(recording, **{name: getattr(recording, name)[kept] for name in channels})

    return fault


def _end(recording: Recording, begin: int, duration_s: float) -> int:
    return int(np.searchsorted(recording.time_s, recording.time_s[begin] + duration_s))
