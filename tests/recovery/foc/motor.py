"""A permanent-magnet synchronous motor under field-oriented control, and what a drive tells of it.

Own equations in the rotor's frame (amplitude-invariant), integrated by Heun's rule in 12.5 µs steps, with a PI current
loop at 20 kHz whose voltage is limited and held for a period; a speed loop at 2 kHz asks for the current.

    L di_d/dt = v_d − R i_d + p ω L i_q
    L di_q/dt = v_q − R i_q − p ω (L i_d + λ)
    J dω/dt   = 1.5 p λ i_q − B ω − Tc tanh(ω/ω0) − load(θ, ω)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

CONTROL_HZ = 20_000
_SUBSTEPS = 4
_SPEED_EVERY = 10
_TC_WIDTH = 0.05  # rad/s: narrower than any motion here rests at


@dataclass(frozen=True)
class FocMotor:
    """R per phase (Ω), L per phase (H), flux (Wb), pole pairs, inertia, friction, dry friction, bus voltage."""

    R: float
    L: float
    flux: float
    pole_pairs: int
    J: float
    B: float
    Tc: float = 0.0
    bus_V: float = 24.0
    current_limit_A: float = 40.0

    def equivalent(self, publish: str) -> dict[str, float]:
        """The DC motor's parameters by what is published, from the literature's table (drive makers' own words)."""
        kt = 1.5 * self.pole_pairs * self.flux
        size = {"kt": (1.5, kt), "line": (2.0, kt * 2 / math.sqrt(3)), "phase": (1.0, kt / math.sqrt(1.5))}[publish]
        return {"R": size[0] * self.R, "L": size[0] * self.L, "K": size[1], "J": self.J, "B": self.B, "Tc": self.Tc}


#: A 270 KV outrunner with a flywheel, and a small gimbal-class motor.
OUTRUNNER = FocMotor(0.039, 15.7e-6, 60 / (2 * math.pi * 270 * math.sqrt(3) * 7), 7, 4e-4, 1.5e-3)
SMALL = FocMotor(2.6, 1.2e-3, 5.5e-3, 7, 2.0e-5, 6e-5, bus_V=12.0, current_limit_A=2.0)


@dataclass(frozen=True)
class Trace:
    """At every control period's beginning: q current as measured, q voltage applied from then on, speed, angle; d
    voltage, and the integral part of the q voltage."""

    i: np.ndarray
    v: np.ndarray
    w: np.ndarray
    th: np.ndarray
    vd: np.ndarray
    vq_integral: np.ndarray


def multisine(size: float, seed: int = 1) -> Callable[[float], float]:
    """Speeds, rad/s: seven sines of 0.3 to 9 Hz about a slow one."""
    rng = np.random.default_rng(seed)
    f = [0.3, 0.7, 1.3, 2.3, 4.1, 6.1, 9.1]
    phase = rng.uniform(0, 2 * math.pi, len(f)).tolist()
    a = [size * s for s in (0.6, 0.4, 0.3, 0.25, 0.15, 0.1, 0.07)]
    terms = list(zip(f, phase, a, strict=True))
    return lambda t: sum(k * math.sin(2 * math.pi * g * t + p) for g, p, k in terms)


def pick_and_place(size: float) -> Callable[[float], float]:
    """Speeds, rad/s: trapezoids to and fro with rests of different lengths."""

    def speed(t: float) -> float:
        k, s = divmod(t, 0.9)
        way = size * (1.0, -0.7, 0.5, -0.8)[int(k) % 4]
        return way * max(0.0, min(s / 0.15, 1.0, (0.65 - s) / 0.15))

    return speed


def run(
    motor: FocMotor,
    speed: Callable[[float], float],
    seconds: float,
    *,
    noise_A: float = 0.0,
    seed: int = 0,
    load: Callable[[float, float], float] = lambda _th, _w: 0.0,
) -> Trace:
    """The motor following speeds.

    `noise_A` is that of the current's sensor, which the current loop acts on; `load` the torque (N·m) against positive
    motion at an angle (rad) and a speed (rad/s), held for a control period.
    """
    n = round(seconds * CONTROL_HZ)
    dt = 1.0 / CONTROL_HZ
    h = dt / _SUBSTEPS
    R, L, p, lam, J, B, Tc = motor.R, motor.L, motor.pole_pairs, motor.flux, motor.J, motor.B, motor.Tc
    kt = 1.5 * p * lam
    wc = 2 * math.pi * 800.0
    kp, ki = wc * L, wc * R
    ws = 2 * math.pi * 25.0
    kps, kis = ws * J / kt, ws * ws * J / kt / 4
    limit, imax = motor.bus_V / math.sqrt(3), motor.current_limit_A
    noise = np.random.default_rng(seed).normal(0.0, 1.0, n) * noise_A
    out = np.empty((6, n))
    idd = iq = w = th = 0.0
    zd = zq = zs = 0.0
    want = 0.0
    tanh = math.tanh
    for k in range(n):
        if k % _SPEED_EVERY == 0:
            e = speed(k * dt) - w
            want = kps * e + zs
            if abs(want) < imax:
                zs += kis * e * dt * _SPEED_EVERY
            want = max(-imax, min(imax, want))
        measured = iq + noise[k]
        ed, eq = -idd, want - measured
        vd = kp * ed + zd - p * w * L * measured
        vq = kp * eq + zq + p * w * lam
        size = math.hypot(vd, vq)
        if size > limit:
            vd, vq = vd * limit / size, vq * limit / size
        else:
            zd += ki * ed * dt
            zq += ki * eq * dt
        out[:, k] = measured, vq, w, th, vd, zq
        held = load(th, w)
        for _ in range(_SUBSTEPS):
            pw = p * w
            ad = (vd - R * idd + pw * L * iq) / L
            aq = (vq - R * iq - pw * (L * idd + lam)) / L
            aw = (kt * iq - B * w - Tc * tanh(w / _TC_WIDTH) - held) / J
            d2, q2, w2 = idd + h * ad, iq + h * aq, w + h * aw
            pw = p * w2
            bd = (vd - R * d2 + pw * L * q2) / L
            bq = (vq - R * q2 - pw * (L * d2 + lam)) / L
            bw = (kt * q2 - B * w2 - Tc * tanh(w2 / _TC_WIDTH) - held) / J
            th += h * (w + 0.5 * h * aw)
            idd += 0.5 * h * (ad + bd)
            iq += 0.5 * h * (aq + bq)
            w += 0.5 * h * (aw + bw)
    return Trace(*out)


def _edges(trace: Trace, hz: float, jitter: float, seed: int) -> np.ndarray:
    """Control periods at which samples are taken."""
    steps = np.arange(1, int(len(trace.i) * hz / CONTROL_HZ)) * CONTROL_HZ / hz
    steps = steps + np.random.default_rng(seed).uniform(-jitter, jitter, len(steps)) * CONTROL_HZ / hz
    return np.unique(np.round(steps).astype(int))


def rounded(x: np.ndarray, step: float) -> np.ndarray:
    return np.round(x / step) * step if step else x


def polled(
    trace: Trace, hz: float, *, jitter: float = 0.1, current_step: float = 0.01, counts: int = 16384, seed: int = 5
) -> dict[str, np.ndarray]:
    """What a poll of a VESC's averages gives: sums over every control period since the last one, by their number."""
    at = _edges(trace, hz, jitter, seed)
    total_i, total_v = (np.concatenate([[0.0], np.cumsum(x)]) for x in (trace.i, trace.v))
    n = np.diff(at)
    return {
        "time_s": at[1:] / CONTROL_HZ,
        "voltage_V": rounded(np.diff(total_v[at]) / n, 1e-3),
        "current_A": rounded(np.diff(total_i[at]) / n, current_step),
        "position_rad": rounded(trace.th[at[1:]], 2 * math.pi / counts),
    }


def instants(
    trace: Trace, hz: float, *, jitter: float = 0.0, current_step: float = 0.0, counts: int = 16384, seed: int = 5
) -> dict[str, np.ndarray]:
    """v_q and i_q of the control period a sample falls into."""
    at = _edges(trace, hz, jitter, seed)
    return {
        "time_s": at / CONTROL_HZ,
        "voltage_V": trace.v[at],
        "current_A": rounded(trace.i[at], current_step),
        "position_rad": rounded(trace.th[at], 2 * math.pi / counts),
    }
