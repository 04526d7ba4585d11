"""Signals with time stamps of their own (MDF, Simulink) brought to one time.

The samples of the capture are those of one signal, the base: the position, else the speed, else the current, …, so that
no motion is invented between two that were measured (`time_base` in the map names another). At them

- the voltage is what was applied from this sample until the next: held from each of its own samples to the next, and
  averaged over the interval where it changes inside (the mean is what the winding's current answers to, see
  docs/model.md on the hold);
- everything else is interpolated linearly between its two neighbours; the temperature is slow and also held beyond its
  ends.

Where a signal other than voltage and temperature is silent for more than `BRIDGE_FACTOR` of its median periods, or has
not begun or has ended, there is nothing to interpolate: the base's samples there are left out, and a note says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64

Bits = NDArray[np.bool_]

#: Up to four lost samples are bridged by interpolation.
BRIDGE_FACTOR = 5.0

#: Which signal is the base, the first of these that is there.
BASE_ORDER = ("position_rad", "velocity_rad_s", "current_A", "torque_Nm", "voltage_V", "temperature_C")


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """A signal with its own time, both shape (n,), n >= 2, time strictly increasing."""

    time_s: F64
    values: F64


def same_time(a: F64, b: F64) -> bool:
    """Whether two signals were sampled at the same instants."""
    return a is b or np.array_equal(a, b)


def to_one_time(signals: Mapping[str, Timed], base: str) -> tuple[F64, dict[str, F64], Bits]:
    """All signals at the samples of the base.

    Args:
        signals: field of `Capture` -> signal, at least one.
        base: which of them gives the time.

    Returns:
        Time of the base, shape (n,); for each signal its values there, shape (n,), without meaning where not kept;
        which samples are kept, shape (n,).
    """
    time_s = signals[base].time_s
    keep = np.ones(len(time_s), np.bool_)
    values: dict[str, F64] = {}
    for name, signal in signals.items():
        if same_time(signal.time_s, time_s):
            values[name] = signal.values
        elif name == "voltage_V":
            values[name], there = _held_mean(signal, time_s)
            keep &= there
        else:
            values[name] = np.interp(time_s, signal.time_s, signal.values)
            if name != "temperature_C":
                keep &= _bridged(signal.time_s, time_s)
    return time_s, values, keep


def held(signal: Timed, time_s: F64) -> tuple[F64, Bits]:
    """The last value at or before each time, shape (n,), and where there is one."""
    before = np.searchsorted(signal.time_s, time_s, side="right") - 1
    return signal.values[np.maximum(before, 0)], before >= 0


def _held_mean(signal: Timed, time_s: F64) -> tuple[F64, Bits]:
    """Mean from each time to the next of a signal that is held between its samples; the last time has its value.

    A value is held no longer than a median period after the last sample.
    """
    value, there = held(signal, time_s)
    there &= time_s <= signal.time_s[-1] + np.median(np.diff(signal.time_s))
    changes = np.searchsorted(signal.time_s, time_s[1:], side="left") > np.searchsorted(
        signal.time_s, time_s[:-1], side="right"
    )
    # The integral of the held signal, about its mean so that nothing is lost to cancellation over a long capture.
    middle = float(signal.values.mean())
    integral = np.concatenate([[0.0], np.cumsum((signal.values[:-1] - middle) * np.diff(signal.time_s))])
    start = np.maximum(np.searchsorted(signal.time_s, time_s, side="right") - 1, 0)
    at = integral[start] + (value - middle) * (time_s - signal.time_s[start])
    mean = middle + np.diff(at) / np.diff(time_s)
    value = value.copy()
    value[:-1][changes] = mean[changes]
    return value, there


def _bridged(own_s: F64, time_s: F64) -> Bits:
    """Where a time lies between two samples that are close enough to interpolate, or on one."""
    after = np.clip(np.searchsorted(own_s, time_s, side="left"), 1, len(own_s) - 1)
    step_s = np.diff(own_s)
    near = step_s[after - 1] <= BRIDGE_FACTOR * np.median(step_s)
    on_one = np.isin(time_s, own_s)
    inside: Bits = (time_s >= own_s[0]) & (time_s <= own_s[-1]) & (near | on_one)
    return inside
