"""The family of motions: blocks of a few seconds, each from rest and back to it, of which a plan is put together.

A shape has no size (its greatest modulus is 1); `scaled` makes it as large as the limits allow, and smaller levels of
it are members of the family in their own right.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.samples import F64

#: Sines in a band, and how many random sets of phases are tried for the lowest crest factor.
_LINES, _PHASE_SETS = 16, 24
#: Share of a block at either end in which a shape comes up from zero and goes back to it.
_FADE = 0.02
#: The highest frequency, of the sample rate.
_TOP = 0.42


@dataclass(frozen=True, slots=True)
class Shape:
    """A member of the family.

    Attributes:
        kind: "multisine", "telegraph", "steps", "reversals", "ramps", "constant", "holds" or "rest".
        detail: its band, level or period, for people.
        wave: shape (n,), greatest modulus 1 (rest: 0).
        level: share of what the limits allow.
    """

    kind: str
    detail: str
    wave: F64
    level: float

    @property
    def text(self) -> str:
        level = "" if self.kind == "rest" else f", {100 * self.level:g} %"
        return f"{self.kind}{' ' if self.detail else ''}{self.detail}{level}"


@dataclass(frozen=True, slots=True)
class Corners:
    """Frequencies of the motor that separate one behaviour from another, Hz."""

    mechanical_hz: float
    electrical_hz: float


def corners(motor: Mapping[str, float]) -> Corners:
    """Of the linear motor: (R B + K²)/(J R) and R/L."""
    R, L, K, J, B = (motor[name] for name in MOTOR_NAMES)
    return Corners((R * B + K * K) / (J * R) / (2 * math.pi), R / L / (2 * math.pi))


def fast_shapes(n: int, rate_hz: float, at: Corners, rng: np.random.Generator) -> Iterator[Shape]:
    """Bands of sines and random telegraph signals: what a servo's reference could not follow."""
    lowest, top = rate_hz / n, _TOP * rate_hz
    mechanical, electrical = (min(max(f, 2 * lowest), top) for f in (at.mechanical_hz, at.electrical_hz))
    bands = {
        (lowest, top),
        (lowest, mechanical),
        (mechanical / 3, min(3 * mechanical, top)),
        (electrical / 3, min(2 * electrical, top)),
        (top / 3, top),
        (lowest, min(top, 1.5 * electrical)),
    }
    for low, high in sorted(bands):
        wave = multisine(n, rate_hz, low, high, rng)
        for level in (1.0, 0.35):
            yield Shape("multisine", f"{low:.3g}–{high:.3g} Hz", wave, level)
    holds = {1, 3, round(rate_hz / electrical / 4), round(rate_hz / mechanical / 6), round(rate_hz / mechanical / 2)}
    for hold in sorted(h for h in holds if 1 <= h <= n / 8):
        wave = _faded(telegraph(n, hold, rng))
        for level in (1.0, 0.35):
            yield Shape("telegraph", f"{1e3 * hold / rate_hz:.3g} ms", wave, level)


def slow_shapes(n: int) -> Iterator[Shape]:
    """Steps, reversals, ramps, constant speeds and rest."""
    turns = np.arange(n) / n
    whole: tuple[tuple[int, tuple[float, ...]], ...] = ((1, (1.0, 0.3, 0.1)), (3, (1.0, 0.3)))
    for periods, levels in whole:
        for level in levels:
            wave = _faded(np.sign(_triangle(turns * periods + 1e-9)) * (np.mod(turns * periods, 0.5) < 0.4))
            yield Shape("steps", f"{2 * periods} in the block", wave, level)
    whole = ((1, (0.3, 0.1, 0.03)), (3, (1.0, 0.3, 0.1, 0.03)))
    for periods, levels in whole:
        for level in levels:
            yield Shape("reversals", f"{2 * periods} in the block", _triangle(turns * periods), level)
    for level in (1.0, 0.3):
        yield Shape("ramps", "up, hold, down, either way", np.clip(1.6 * _triangle(turns), -1, 1), level)
    for level in (1.0, 0.3, 0.05):
        yield Shape("constant", "one way", np.clip(np.minimum(turns, 1 - turns) / 0.1, 0, 1), level)
    yield Shape("rest", "", np.zeros(n), 0.0)


def servo_shapes(n: int, rate_hz: float, bandwidth_hz: float, rng: np.random.Generator) -> Iterator[Shape]:
    """What a servo can follow beside slow shapes: bands of sines up to past its bandwidth, and steps at random."""
    lowest = rate_hz / n
    top = min(_TOP * rate_hz, max(3 * bandwidth_hz, 3 * lowest))
    for low, high in ((lowest, top), (lowest, max(top / 10, 2 * lowest)), (top / 4, top)):
        wave = multisine(n, rate_hz, low, high, rng)
        for level in (1.0, 0.35):
            yield Shape("multisine", f"{low:.3g}–{high:.3g} Hz", wave, level)
    for hold in sorted({max(1, round(rate_hz / top)), max(1, round(3 * rate_hz / top))}):
        if hold <= n / 8:
            wave = _faded(telegraph(n, hold, rng))
            for level in (1.0, 0.35):
                yield Shape("telegraph", f"{1e3 * hold / rate_hz:.3g} ms", wave, level)


def hold_shapes(n: int) -> Iterator[Shape]:
    """For an angle's reference: rest at several angles, reached by smooth moves."""
    for places in ((1.0, -1.0, 0.5, -0.5), (0.25, 0.75, -0.25, -0.75), (1.0, 0.0, -1.0, 0.0)):
        for level in (1.0, 0.3):
            yield Shape("holds", "at " + ", ".join(f"{p:g}" for p in places), _staircase(n, places), level)


def multisine(n: int, rate_hz: float, low: float, high: float, rng: np.random.Generator) -> F64:
    """Sines at multiples of 1/(block length), equal in size, phases of low crest: of many random sets the best."""
    first = rate_hz / n
    lines = np.unique(np.rint(np.geomspace(max(low, first), max(high, 2 * first), _LINES) / first))
    t = np.arange(n) / rate_hz
    angles = 2 * math.pi * first * lines[:, None] * t
    # Schroeder's phases (IEEE Trans. Inf. Theory 16, 1970) and random ones: his are for lines next to each other.
    sets = [-math.pi * np.arange(len(lines)) ** 2 / len(lines), *rng.uniform(0, 2 * math.pi, (_PHASE_SETS, len(lines)))]
    best = min((np.sin(angles + phase[:, None]).sum(axis=0) for phase in sets), key=_crest)
    return np.asarray(best / np.abs(best).max())


def telegraph(n: int, hold: int, rng: np.random.Generator) -> F64:
    """±1 at random, each held for 1 … 2 `hold` samples."""
    lengths = rng.integers(hold, 2 * hold + 1, size=n // hold + 2)
    signs = rng.choice([-1.0, 1.0], size=len(lengths))
    return np.asarray(np.repeat(signs, lengths)[:n])


def scaled(shape: Shape, peak: Callable[[F64], float]) -> F64:
    """A shape at its level of what the limits allow, shape (n,).

    Args:
        peak: of a reference, the share of the nearest limit that it reaches; the motor is taken to be linear.
    """
    share = peak(shape.wave) if np.any(shape.wave) else 1.0
    return np.asarray(shape.wave * (shape.level / share))


def _crest(wave: F64) -> float:
    return float(np.abs(wave).max() / np.sqrt(np.mean(wave * wave)))


def _faded(wave: F64) -> F64:
    n = len(wave)
    edge = np.minimum(np.arange(n), np.arange(n)[::-1]) / max(_FADE * n, 1.0)
    return np.asarray(wave * np.clip(edge, 0.0, 1.0))


def _triangle(turns: F64) -> F64:
    """Period 1, from 0 up to 1, down to −1, back to 0."""
    return np.asarray(2 / math.pi * np.arcsin(np.sin(2 * math.pi * turns)))


def _staircase(n: int, places: tuple[float, ...]) -> F64:
    """From 0 to each place and back to 0: half of the time moving (minimum jerk), half at rest."""
    stops = np.array([0.0, *places, 0.0])
    u = np.arange(n) / n * (len(stops) - 1)
    k = np.minimum(u.astype(int), len(stops) - 2)
    s = np.clip(2 * (u - k), 0.0, 1.0)
    return np.asarray(stops[k] + (stops[k + 1] - stops[k]) * s**3 * (10 - 15 * s + 6 * s * s))
