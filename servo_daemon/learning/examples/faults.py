"""Windows in which something went wrong with the measuring, for the training: what a model must decline.

Nothing here is tuned to a certain fault: any channel may be lost, freeze, spike, come late, be shifted from some moment
on (an encoder that slips) or have the wrong sign, for any part of the window and by any amount that would harm. Whether
a window shows it is for the model to find out (`novelty`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from servo_daemon.samples import F64, SampleBlock

#: Channels that go wrong.
_CHANNELS = ("voltage_V", "current_A", "position_rad", "velocity_rad_s")
_Fault = Callable[[np.random.Generator, F64], F64]


def with_fault(block: SampleBlock, rng: np.random.Generator) -> tuple[SampleBlock, str]:
    """The window as it would be with a random fault of a random channel, and the fault's name.

    Args:
        block: n ≥ 64 samples; it stays as it is.
    """
    channel = str(rng.choice([c for c in _CHANNELS if c in block.channels]))
    name = str(rng.choice(list(FAULTS)))
    changed: dict[str, Any] = {channel: FAULTS[name](rng, getattr(block, channel))}
    return replace(block, **changed), name


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """A draw whose logarithm is uniform."""
    return float(low * (high / low) ** rng.random())


def _pieces(rng: np.random.Generator, n: int) -> list[slice]:
    """One to three pieces that together are 1 to 30 % of n samples."""
    count = int(rng.integers(1, 4))
    length = max(3, round(n * _between(rng, 0.01, 0.3) / count))
    return [slice(k, k + length) for k in rng.integers(0, max(n - length, 1), size=count).tolist()]


def _lost(rng: np.random.Generator, x: F64) -> F64:
    """Zero for a while, or noise all the time."""
    if rng.random() < 0.15:
        return np.asarray(_between(rng, 1e-3, 3e-2) * np.abs(x).max() * rng.normal(size=len(x)))
    out = x.copy()
    for piece in _pieces(rng, len(x)):
        out[piece] = 0.0
    return out


def _frozen(rng: np.random.Generator, x: F64) -> F64:
    """The last value before stands for a while."""
    out = x.copy()
    for piece in _pieces(rng, len(x)):
        out[piece] = x[piece.start]
    return out


def _spiked(rng: np.random.Generator, x: F64) -> F64:
    """Up to 3 % of the samples are far off."""
    out = x.copy()
    where = rng.integers(len(x), size=max(3, round(len(x) * _between(rng, 0.001, 0.03))))
    out[where] += _between(rng, 0.5, 5.0) * np.abs(x).max() * rng.choice((-1.0, 1.0), size=len(where))
    return out


def _late(rng: np.random.Generator, x: F64) -> F64:
    """Told 2 to 15 samples late."""
    k = round(_between(rng, 2.0, 15.0))
    return np.concatenate([np.full(k, x[0]), x[:-k]])


def _shifted(rng: np.random.Generator, x: F64) -> F64:
    """From one to five moments on off by something: an encoder that slips, a zero that jumps."""
    out = x.copy()
    size = _between(rng, 0.01, 0.3) * float(np.ptp(x))
    for k in rng.integers(len(x), size=int(rng.integers(1, 6))).tolist():
        out[k:] += size * float(rng.choice((-1.0, 1.0)))
    return out


def _reversed(_: np.random.Generator, x: F64) -> F64:
    return -x


#: What can go wrong with a channel, by name.
FAULTS: Mapping[str, _Fault] = {
    "lost": _lost,
    "frozen": _frozen,
    "spiked": _spiked,
    "late": _late,
    "shifted": _shifted,
    "reversed": _reversed,
}
