"""Reference motions: what the simulated servo is asked to do, as functions of time.

The default programme makes every parameter visible. The paper's 50° steps excite the fast modes (R against K, J, L); up
and down ramps at several speeds in both directions separate viscous friction from back-EMF and dry friction; a sweep
covers the frequencies between. A multisine dither on the voltage, a few percent of the supply, reaches above R/L, where
alone L can be seen, and goes on all the time, so that no parameter is ever quite invisible.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.samples import F64

MotionName = Literal["mixed", "steps", "speed", "rest"]

STEP_RAD = math.radians(50.0)  # the paper's reference angle
#: The mixed motion: so long steps, ramps and a sweep, s.
_STEPS_S, _RAMPS_S, _SWEEP_S = 4.0, 6.0, 6.0
_PROGRAMME_S = _STEPS_S + _RAMPS_S + _SWEEP_S
#: The multisine on top of it: its period, s, and lines.
_DITHER_PERIOD_S = 8.0
_DITHER_LINES = 24
_DITHER_PHASES = 136  # of the seeds 0..299 the one with the lowest peak at 100 Hz to 10 kHz: 3.2 times the RMS


@dataclass(frozen=True)
class Motion:
    """A wanted angle and a voltage dither.

    Attributes:
        name: "mixed" (see above), "steps" (0, 50°, 0, −50°, one second each), "speed" (constant), "rest" (standstill).
        peak_speed_rad_s: greatest speed of ramps and sweep; the speed of "speed".
        dither_rms_V: of the multisine on the voltage; 0 for none.
        rate_hz: sample rate; the dither stays below 0.4 of it and below `dither_top_hz`.
        dither_top_hz: highest line of the multisine.
    """

    name: MotionName = "mixed"
    peak_speed_rad_s: float = 8.0
    dither_rms_V: float = 1.4
    rate_hz: float = 1000.0
    dither_top_hz: float = 150.0

    def __post_init__(self) -> None:
        if self.name not in get_args(MotionName):
            raise BadInputError(f"unknown motion {self.name!r}: known are {', '.join(get_args(MotionName))}")
        for name in ("peak_speed_rad_s", "dither_rms_V"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise BadInputError(f"{name} must be a number of at least 0, not {value!r}")

    def reference(self, t: F64) -> F64:
        """Wanted angle, rad, at times t (n,), s."""
        if self.name == "rest":
            return np.zeros_like(t)
        if self.name == "speed":
            return self.peak_speed_rad_s * t
        if self.name == "steps":
            return _steps(t)
        phase = np.mod(t, _PROGRAMME_S)
        sweep = phase - _STEPS_S - _RAMPS_S
        angle = np.where(phase < _STEPS_S, _steps(phase), _ramps(phase - _STEPS_S, self.peak_speed_rad_s))
        return np.where(sweep >= 0, _sweep(np.maximum(sweep, 0.0), self.peak_speed_rad_s), angle)

    def dither(self, t: F64) -> F64:
        """Voltage added to the command, V, at times t (n,), s."""
        if self.dither_rms_V == 0:
            return np.zeros_like(t)
        omega, phase = self._lines
        amplitude = self.dither_rms_V * math.sqrt(2.0 / len(omega))
        total = np.zeros_like(t)
        within = np.mod(t, _DITHER_PERIOD_S)
        for w, start in zip(omega, phase, strict=True):
            total += np.sin(w * within + start)
        return amplitude * total

    @cached_property
    def _lines(self) -> tuple[F64, F64]:
        """Angular frequencies (rad/s) and phases of the multisine: harmonics of 1/8 Hz, spaced logarithmically."""
        top = max(2.0, min(self.dither_top_hz, 0.4 * self.rate_hz) * _DITHER_PERIOD_S)
        harmonics = np.unique(np.rint(np.geomspace(min(8.0, top / 2), top, _DITHER_LINES)))
        phases = np.random.default_rng(_DITHER_PHASES).uniform(0.0, 2 * math.pi, len(harmonics))
        return 2 * math.pi * harmonics / _DITHER_PERIOD_S, phases


def _steps(t: F64) -> F64:
    """0, +50°, 0, −50°, a second each."""
    return STEP_RAD * np.array([0.0, 1.0, 0.0, -1.0])[np.floor(np.mod(t, 4.0)).astype(np.intp)]


def _ramps(t: F64, peak: float) -> F64:
    """Triangles over 6 s: 3 s at peak/4, 2 s at peak/2, 1 s at the peak; each begins and ends at 0."""
    angle = np.zeros_like(t)
    start = 0.0
    for period, speed in ((3.0, peak / 4), (2.0, peak / 2), (1.0, peak)):
        u = (t - start) / period
        triangle = np.where(u < 0.25, u, np.where(u < 0.75, 0.5 - u, u - 1.0))
        angle = np.where((u >= 0) & (u < 1), speed * period * triangle, angle)
        start += period
    return angle


def _sweep(t: F64, peak: float) -> F64:
    """A logarithmic sweep from 0.3 to 5 Hz in 6 s whose amplitude falls as its frequency rises: constant peak speed,
    at first less than 100°."""
    low, high = 0.3, 5.0
    pace = math.log(high / low) / _SWEEP_S
    frequency = low * np.exp(pace * t)
    amplitude = np.minimum(peak / (2 * math.pi * frequency), peak / (2 * math.pi * 2 * low))
    fade = np.clip(np.minimum(t, _SWEEP_S - t) / 0.3, 0.0, 1.0)  # from rest and back to it
    return fade * amplitude * np.sin(2 * math.pi * (frequency - low) / pace)
