"""The first voltages a motor gets: a multisine that grows from almost nothing."""

from __future__ import annotations

import math

import numpy as np

from servo_daemon.samples import F64

#: Lines, Hz: from where the shaft of a small motor turns by degrees, to a fifth of the sample rate; spaced evenly in
#: the logarithm.
_LOWEST_HZ, _HIGHEST_SHARE, _LINES = 2.0, 0.2, 14
#: The first voltage, as a share of the limit, and the time in which it grows e-fold, s: two periods of the slowest
#: line, so that one swing shows what the next will reach.
_FIRST, GROWTH_S = 0.002, 0.8
#: No first voltage goes beyond this share of the limit.
_MOST = 0.6


def growing(rate_hz: float, voltage_V: float, seed: int) -> F64:
    """Shape (n,), V: a multisine whose peak grows from 0.2 % to 60 % of `voltage_V`."""
    seconds = GROWTH_S * math.log(_MOST / _FIRST)
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    lines = np.geomspace(_LOWEST_HZ, max(2 * _LOWEST_HZ, _HIGHEST_SHARE * rate_hz), _LINES)
    phases = np.random.default_rng(seed).uniform(0.0, 2 * math.pi, _LINES)
    # Slow lines move the shaft, fast ones show the winding: amplitude falls with the root of the frequency.
    wave = sum(
        (np.sin(2 * math.pi * f * t + p) / math.sqrt(f) for f, p in zip(lines, phases, strict=True)), np.zeros(1)
    )
    unit = wave / np.abs(wave).max()
    return np.asarray(voltage_V * _FIRST * np.exp(t / GROWTH_S) * unit)
