"""Where to look for what repeats or happens once: frequencies, harmonics of the turn, event times."""

from __future__ import annotations

import numpy as np

from servo_daemon.numerics import sample_period
from servo_daemon.plant.columns.screening import Context
from servo_daemon.samples import F64

#: Harmonics of the turn that are looked at, and how many of the best are tried exactly.
HARMONICS, _TRIED = 64, 3
#: A harmonic is looked for where a sample passes no more of it than this, rad.
_RESOLVED, _SECTORS = 1.5, 4096


def spectral_lines(t: F64, r: F64, count: int) -> list[float]:
    """Frequencies, Hz, of the highest peaks of a series over (nearly) even time, between two periods in it and a
    quarter of its rate; refined by a parabola through the peak."""
    n, period = len(r), sample_period(t)
    even = np.interp(t[0] + period * np.arange(round((t[-1] - t[0]) / period) + 1), t, r) if n > 1 else r
    window = np.hanning(len(even))
    size = 1 << (4 * len(even) - 1).bit_length()
    power = np.abs(np.fft.rfft((even - even.mean()) * window, size)) ** 2
    f = np.fft.rfftfreq(size, period)
    power[(f < 2.0 / (t[-1] - t[0])) | (f > 0.25 / period)] = 0.0
    out = []
    for _ in range(count):
        k = int(np.argmax(power))
        if power[k] <= 0 or k + 1 >= len(power):
            break
        left, mid, right = np.log(np.maximum(power[k - 1 : k + 2], 1e-300))
        bend = left - 2 * mid + right
        out.append(float(f[k] + (0.5 * (left - right) / bend if bend < 0 and power[k - 1] > 0 else 0.0) * f[1]))
        power[max(0, k - 16) : k + 17] = 0.0
    return out


def best_harmonics(c: Context, weight: F64, series: str = "torque") -> list[int]:
    """The harmonics of the turn, from 2 on, that a raw series shows most, modulated by a weight of shape (n,)."""
    theta, r = c.motion.theta, np.where(c.motion.rest, 0.0, c.residual[series] * weight)
    least = int(np.ceil(2 * np.pi / max(float(np.ptp(theta)), 1e-9)))  # one whole period must have been passed
    sector = np.mod(theta * (_SECTORS / (2 * np.pi)), _SECTORS).astype(int) % _SECTORS
    passed, power = np.abs(c.motion.omega * c.motion.h), np.zeros(HARMONICS + 1)
    low = max(2, least)
    while low <= HARMONICS:  # octave by octave: sums by sector, then all harmonics at once
        high = min(2 * low - 1, HARMONICS)
        resolved = passed * high < _RESOLVED
        sums = np.bincount(sector[resolved], r[resolved], _SECTORS)
        power[low : high + 1] = np.abs(np.fft.rfft(sums)[low : high + 1]) ** 2 / max(int(resolved.sum()), 1)
        low = high + 1
    ranked = np.argsort(power)[::-1][:_TRIED]
    return [int(n) for n in ranked if power[n] > 0]


def step_times(r: F64, weight: F64) -> list[int]:
    """Where a step of the coefficient of `weight`, shape (n,), explains most of r: from sample k on."""
    after, room = np.cumsum((r * weight)[::-1])[::-1], np.cumsum((weight**2)[::-1])[::-1]
    n, total = len(r), max(float(room[0]), 1e-300)
    explained = after**2 / np.maximum(room, 1e-300)
    # Measured against the rest before it as well: what is there throughout is no step.
    contrast = (after - room / total * after[0]) ** 2 / np.maximum(room * (1 - room / total), 1e-6 * total)
    within = (np.arange(n) >= 0.02 * n) & (np.arange(n) <= 0.98 * n) & (room > 0.01 * total) & (room < 0.99 * total)
    if not within.any():
        return []
    return sorted({int(np.argmax(np.where(within, s, -1.0))) for s in (explained, contrast)})
