"""What a candidate of the screening is made of: columns with a meaning, and what their coefficients say.

A torque τ counts positive against positive motion. A sensor's error moves both series: with the true signals in the
balances and the shown ones in the model,

    i + i0 shown         d_T = K i0                    d_V = −R i0
    i t_d late           d_T = −K t_d di/dt            d_V = R t_d di/dt + L t_d d²i/dt²
    θ t_d late           d_T = J t_d d²ω/dt² + B t_d dω/dt        d_V = K t_d dω/dt
    θ + e sin(θ + φ)     d_T = −J d(ω e cos)/dt − B ω e cos       d_V = −K ω e cos(θ + φ)

They are not evaluated from these formulas, which need derivatives, but by carrying the error through the smoother.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64

#: Time constants of lags that are tried, s.
LAGS_S = np.geomspace(2e-4, 3e-2, 7)
#: Start values in SI units by parameter; None: no physical value gives these coefficients.
Start = Mapping[str, float | str]


@dataclass(frozen=True)
class Trace:
    """One column of a supposed cause, per unit of its coefficient; all shapes (n,).

    Attributes:
        torque: load torque that is not in the model, N·m; None: none.
        voltage: voltage drop that is not in the model, V.
        shown: error of a measured channel, by name.
    """

    torque: F64 | None = None
    voltage: F64 | None = None
    shown: Mapping[str, F64] = field(default_factory=dict)


@dataclass(frozen=True)
class Motion:
    """Shapes (n,): value k is the mean over the step from sample k to the next.

    Attributes:
        p: the plant's parameters in natural units.
        t, h: s, at the sample and to the next.
        u: the input, held over the step.
        i, omega, theta: A, rad/s, rad; i is 0 where the input is a torque.
        i_rate, omega_rate: A/s, rad/s².
        at_sample: current_A and position_rad at the samples themselves, and their rates.
        rest: whether the shaft stands.
    """

    p: Mapping[str, float]
    t: F64
    h: F64
    u: F64
    i: F64
    omega: F64
    theta: F64
    i_rate: F64
    omega_rate: F64
    at_sample: Mapping[str, F64]
    rest: NDArray[np.bool_]

    @cached_property
    def direction(self) -> F64:
        return np.asarray(np.sign(self.omega))


@dataclass(frozen=True)
class Basis:
    """One effect at one point of its scan.

    Attributes:
        columns: keys into the table of traces.
        start: coefficients, shape (columns,), -> start values, or None where no physical value gives them.
        parameters: how many the effect has, scanned ones included.
    """

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


def relaxed(push: F64, h: F64, tau: float) -> F64:
    """y⁺ = y exp(−h/τ) + push, shape (n,), from rest; h may vary."""
    from scipy.signal import lfilter

    decay = float(np.exp(-np.median(h) / tau))
    return np.asarray(lfilter([0.0, 1.0], [1.0, -decay], push))
