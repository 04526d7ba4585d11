"""What a drawn motor is made to do: what servo axes do, from rich to poor, in closed and in open loop."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from servo_daemon.samples import F64
from servo_daemon.simulate import Motion, Settings


@dataclass(frozen=True)
class DrawnMotion(Motion):
    """A wanted angle and an added voltage, sample by sample.

    Attributes:
        angle_rad, added_V: shape (n,).
    """

    angle_rad: F64 = field(default_factory=lambda: np.zeros(1))
    added_V: F64 = field(default_factory=lambda: np.zeros(1))

    def reference(self, t: F64) -> F64:
        """Wanted angle, rad, at times t (n,), s; held after the last sample."""
        return self.angle_rad[self._index(t)]

    def dither(self, t: F64) -> F64:
        """Voltage added to the command, V, at times t (n,), s."""
        return self.added_V[self._index(t)]

    def _index(self, t: F64) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
        return np.minimum(np.rint(t * self.rate_hz).astype(np.intp), len(self.angle_rad) - 1)


def draw_motion(rng: np.random.Generator, samples: int, settings: Settings, *, open_loop: bool) -> DrawnMotion:
    """A motion of so many samples for the motor of these settings."""
    rate, supply = settings.rate_hz, settings.supply_V
    t = np.arange(samples) / rate
    # The speed that the programme of `Motion` asks for is 38 % of what the whole supply gives.
    speed = settings.motion.peak_speed_rad_s * 10.0 ** rng.uniform(-0.7, 0.3)
    angle = np.zeros(samples)
    if not open_loop:
        angle = _REFERENCES[int(rng.integers(len(_REFERENCES)))](rng, t, speed)
    share = rng.uniform(0.1, 0.45) if open_loop else 10.0 ** rng.uniform(-2.3, -0.7)
    added = _VOLTAGES[int(rng.integers(len(_VOLTAGES)))](rng, t) * share * supply
    if open_loop:
        added = added + supply * _levels(rng, t) * rng.uniform(0.0, 0.4)
    return DrawnMotion("mixed", speed, 0.0, rate, angle_rad=angle, added_V=added)


def _held(rng: np.random.Generator, t: F64, least_s: float, most_s: float) -> F64:
    """Random numbers in −1..1, each held for a random time."""
    ends = np.cumsum(rng.uniform(least_s, most_s, size=int(t[-1] / least_s) + 2))
    return np.asarray(rng.uniform(-1.0, 1.0, size=len(ends) + 1)[np.searchsorted(ends, t, side="right")])


def _steps(rng: np.random.Generator, t: F64, speed: float) -> F64:
    return _held(rng, t, 0.3, 1.5) * speed * 0.2


def _moves(rng: np.random.Generator, t: F64, speed: float) -> F64:
    """Minimum-jerk moves between random places, with dwells."""
    out, begin, place = np.empty_like(t), 0.0, 0.0
    while begin <= t[-1]:
        target = rng.uniform(-1.0, 1.0) * speed * 0.4
        duration = max(1.875 * abs(target - place) / speed, 0.05) * rng.uniform(1.0, 2.0)
        end = begin + duration + rng.uniform(0.0, 0.4)
        here = (t >= begin) & (t < end)
        u = np.clip((t[here] - begin) / duration, 0.0, 1.0)
        out[here] = place + (target - place) * u**3 * (10 - 15 * u + 6 * u**2)
        begin, place = end, target
    return out


def _triangles(rng: np.random.Generator, t: F64, speed: float) -> F64:
    """Constant speeds with reversals."""
    period = rng.uniform(0.5, 6.0)
    turns = t / period + rng.random()
    return np.asarray(speed * period / 4 * (2 / math.pi) * np.arcsin(np.sin(2 * math.pi * turns)))


def _sines(rng: np.random.Generator, t: F64, speed: float) -> F64:
    """A few sines from 0.2 to 8 Hz, whose peak speeds add up to `speed`."""
    out = np.zeros_like(t)
    count = int(rng.integers(1, 6))
    for _ in range(count):
        omega = 2 * math.pi * 0.2 * 40.0 ** rng.random()
        out += speed / (count * omega) * np.sin(omega * t + rng.uniform(0.0, 2 * math.pi))
    return out


def _turning(rng: np.random.Generator, t: F64, speed: float) -> F64:
    """One way, at levels of speed that change on ramps."""
    knots = np.cumsum(rng.uniform(0.3, 2.0, size=int(t[-1] / 0.3) + 3)) - 0.3
    pace = np.interp(t, knots, rng.uniform(-0.3, 1.0, size=len(knots))) * speed
    return np.asarray(np.cumsum(pace) * (t[1] - t[0]))


def _multisine(rng: np.random.Generator, t: F64) -> F64:
    """RMS 1, up to 24 tones from 0.3 Hz to a random top below 0.4 of the sample rate."""
    top = 0.4 / (t[1] - t[0]) * 10.0 ** rng.uniform(-1.5, 0.0)
    tones = 0.3 * (max(top, 1.0) / 0.3) ** rng.random(int(rng.integers(6, 25)))
    tilt = tones ** rng.uniform(-0.5, 0.2)
    phases = rng.uniform(0.0, 2 * math.pi, size=len(tones))
    wave = tilt @ np.sin(2 * math.pi * tones[:, None] * t + phases[:, None])
    return np.asarray(wave / max(float(np.sqrt(np.mean(wave**2))), 1e-9))


def _telegraph(rng: np.random.Generator, t: F64) -> F64:
    """Between −1 and 1, held 0.01–0.5 s."""
    least = 10.0 ** rng.uniform(-2.0, -1.0)
    return np.sign(_held(rng, t, least, 10.0 * least))


def _levels(rng: np.random.Generator, t: F64) -> F64:
    knots = np.cumsum(rng.uniform(0.5, 3.0, size=int(t[-1] / 0.5) + 3)) - 0.5
    return np.interp(t, knots, rng.uniform(-1.0, 1.0, size=len(knots)))


_REFERENCES: tuple[Callable[[np.random.Generator, F64, float], F64], ...] = (
    _steps,
    _moves,
    _triangles,
    _sines,
    _turning,
)
_VOLTAGES: tuple[Callable[[np.random.Generator, F64], F64], ...] = (_multisine, _multisine, _telegraph)
