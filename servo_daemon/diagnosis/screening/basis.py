"""What a candidate of the screening is made of: columns with a meaning, and what their coefficients say."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from servo_daemon.diagnosis.missing.response import Trace
from servo_daemon.diagnosis.missing.signals import Motion
from servo_daemon.samples import F64

#: Start values in SI units by parameter; None: no physical value gives these coefficients.
Start = Mapping[str, float | str]


@dataclass(frozen=True)
class Basis:
    """One effect at one point of its scan.

    Attributes:
        effect: name of the contract.
        columns: keys into the table of traces.
        start: coefficients, shape (columns,), -> start values, or None where no physical value gives them.
        parameters: how many the effect has, scanned ones included.
    """

    effect: str
    columns: tuple[str, ...]
    start: Callable[[F64], Start | None]
    parameters: int


@dataclass(frozen=True)
class Context:
    """What the formulas may use.

    Attributes:
        motion: smoothed signals.
        residual: raw series less what the plant's own free parameters explain, by name, shapes (n,), 0 at rest; for
            scans over many values.
        rest_friction: shape (n,): share of the dry friction that the shaft holds at rest, -1 .. 1; the direction
            of motion elsewhere.
        channels: what is measured.
        traces: columns so far, by key.
    """

    motion: Motion
    residual: Mapping[str, F64]
    rest_friction: F64
    channels: tuple[str, ...]
    traces: dict[str, Trace] = field(default_factory=dict)

    def torque(self, key: str, values: F64) -> str:
        return self.add(key, Trace(torque=values))

    def voltage(self, key: str, values: F64) -> str:
        return self.add(key, Trace(voltage=values))

    def add(self, key: str, trace: Trace) -> str:
        self.traces.setdefault(key, trace)
        return key


#: The bases of one effect over its scan.
Family = Callable[[Context], Iterable[Basis]]


def positive(*values: float) -> bool:
    return all(np.isfinite(v) and v > 0 for v in values)


def phase(sine: float, cosine: float) -> tuple[float, float]:
    """Amplitude ≥ 0 and phase of a sin x + b cos x = A sin(x + φ)."""
    return float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
