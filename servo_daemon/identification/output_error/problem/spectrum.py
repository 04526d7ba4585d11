"""Spectral lines of a series."""

from __future__ import annotations

import numpy as np

from servo_daemon.samples import F64


def spectral_lines(t: F64, r: F64, count: int) -> list[float]:
    """Frequencies, Hz, of the highest peaks of a series over (nearly) even time, between two periods in it and a
    quarter of its rate; refined by a parabola through the peak."""
    n, period = len(r), float(np.median(np.diff(t)))
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
