"""Given parameters that the capture excludes: at a steady speed K ω is not more than the voltage that keeps it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from servo_daemon.captures.capture.model import Capture
from servo_daemon.captures.meaning.windows import Windows, travelled

#: Windows of this length, s: a winding has settled in it, a few steps of an encoder are small.
_WINDOW_S, _LEAST = 0.05, 8
#: Steady: the speed changes by less than this share from window to window; fast: at least this share of the fastest.
_STEADY, _FAST, _FEWEST = 0.05, 0.3, 5
#: K ω beyond the voltage by this share is no matter of the sensors.
_BEYOND = 1.1
#: ... where both directions are seen: in one alone a load may drive all the time, with half of the voltage at the most.
_BEYOND_ONE_WAY = 2.0
#: Factors by which units differ.
_FACTORS = (
    (2 * math.pi, "turns for radians"),
    (180 / math.pi, "degrees for radians"),
    (60 / (2 * math.pi), "rpm for rad/s"),
    (1000.0, "a thousandth"),
)
#: … to this share; the two nearest of them, turns and rpm, are a factor of 1.5 apart.
_NEAR = 0.15


def excluded_values(capture: Capture, given: Mapping[str, float]) -> list[str]:
    """Sentences on a given K that the steady state excludes.

    Args:
        given: nominal and fixed values, SI units.
    """
    K = given.get("K")
    travel = travelled(capture)
    if K is None or capture.voltage_V is None or travel is None:
        return []
    m = max(_LEAST, round(_WINDOW_S / capture.sample_period_s))
    w = Windows.of(capture.time_s, capture.voltage_V, travel, m)
    if len(w) < _FEWEST + 2:
        return []
    change = np.maximum(np.abs(np.diff(w.speed[:-1])), np.abs(np.diff(w.speed[1:])))
    speed, voltage = w.speed[1:-1], w.voltage[1:-1]
    fastest = float(np.max(np.abs(w.speed)))
    steady = (change < _STEADY * np.abs(speed)) & (np.abs(speed) > _FAST * fastest) & (voltage * speed > 0.0)
    if np.count_nonzero(steady) < _FEWEST:
        return []
    ratio = voltage[steady] / speed[steady]
    most = float(np.max(ratio))  # a load that drives lowers it, none raises it
    alone = min(np.count_nonzero(speed[steady] > 0.0), np.count_nonzero(speed[steady] < 0.0)) < _FEWEST
    beyond = (_BEYOND_ONE_WAY if alone else _BEYOND) * most
    if beyond >= K:
        return []
    fast, volts = abs(float(speed[steady][np.argmax(ratio)])), abs(float(voltage[steady][np.argmax(ratio)]))
    text = (
        f"K = {K:g} as given cannot be: at a steady {fast:.4g} rad/s K ω would be {K * fast:.4g} V, the voltage is "
        f"{volts:.4g} V: K is {most:.4g} V·s/rad at the most"
    )
    for factor, words in _FACTORS:
        if abs(K / most / factor - 1.0) < _NEAR:
            text += f" (about 1/{factor:.4g}: {words}?)"
            break
    return [f"{text}. mend: leave K out of what is given, or give K={most:.4g} or less"]
