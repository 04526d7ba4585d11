"""Candidates that act on the winding, on both balances, or on what the sensors show.

A sensor's error moves both series: with the true signals in the balances and the shown ones in the model,

    i + i0 shown         d_T = K i0                    d_V = −R i0
    i t_d late           d_T = −K t_d di/dt            d_V = R t_d di/dt + L t_d d²i/dt²
    θ t_d late           d_T = J t_d d²ω/dt² + B t_d dω/dt        d_V = K t_d dω/dt
    θ + e sin(θ + φ)     d_T = −J d(ω e cos)/dt − B ω e cos       d_V = −K ω e cos(θ + φ)

They are not evaluated from these formulas, which need derivatives, but by carrying the error through the smoother.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servo_daemon.diagnosis.missing.response import Trace
from servo_daemon.diagnosis.screening.basis import Basis, Context, Family, phase, positive
from servo_daemon.diagnosis.screening.torque_families import best_harmonics, step_instants
from servo_daemon.samples import F64

#: Copper, 1/K.
_ALPHA = 0.0039
#: Scans: thermal time constants in shares of the capture, knees in shares of the greatest current, lags in s.
_THERMAL, _KNEES = (0.05, 0.15, 0.4, 1.5), (0.7, 1.2, 2.0, 4.0)
_LAGS_S = np.geomspace(2e-4, 3e-2, 7)
#: No current sensor is further off.
_MOST_GAIN = 0.6
#: rad; an encoder's disk that runs further out of true is not read any more. Without a bound an angle that is wrong by
#: a radian stands for any gravity.
_MOST_ECCENTRIC = 0.3


def _ripple(c: Context) -> Iterator[Basis]:
    m = c.motion
    if "K" not in m.p or "torque" not in c.residual:
        return
    torque, emf = -m.p["K"] * m.i, m.p["K"] * m.omega
    for n in best_harmonics(c, torque):

        def start(b: F64, n: int = n) -> dict[str, float]:
            size, angle = phase(b[0], b[1])
            return {"k_rip": size, "n_rip": float(n), "phi_rip": angle}

        s, k = np.sin(n * m.theta), np.cos(n * m.theta)
        columns = (
            c.add(f"ripple sin {n}", Trace(torque=torque * s, voltage=emf * s)),
            c.add(f"ripple cos {n}", Trace(torque=torque * k, voltage=emf * k)),
        )
        yield Basis("torque_ripple", columns, start, 3)


def _saturation(c: Context) -> Iterator[Basis]:
    m = c.motion
    if "K" not in m.p:
        return
    for knee in np.array(_KNEES) * float(np.max(np.abs(m.i))):

        def start(b: F64, knee: float = float(knee)) -> dict[str, float] | None:
            # A motor that loses more than half of its torque is none; without a bound any torque is "lost".
            if not positive(b[0]) or knee / float(np.sqrt(b[0])) < float(np.max(np.abs(m.i))):
                return None
            return {"I_sat": knee / float(np.sqrt(b[0]))}

        lost = 1 - 1 / (1 + (m.i / knee) ** 2)
        trace = Trace(torque=m.p["K"] * m.i * lost, voltage=-m.p["K"] * m.omega * lost)
        yield Basis("magnetic_saturation", (c.add(f"knee {knee}", trace),), start, 1)


def _heating(c: Context) -> Iterator[Basis]:
    m = c.motion
    for share in _THERMAL:
        tau = share * float(m.t[-1] - m.t[0])

        def start(b: F64, tau: float = tau) -> dict[str, float] | None:
            return {"R_th": tau * b[0], "C_th": 1 / b[0]} if positive(b[0]) else None

        per_heat = _relaxed(m.p["R"] * m.i**2 * m.h, m.h, tau)
        yield Basis("winding_heating", (c.voltage(f"warm {tau}", m.p["R"] * _ALPHA * per_heat * m.i),), start, 2)


def _relaxed(push: F64, h: F64, tau: float) -> F64:
    """y⁺ = y exp(−h/τ) + push, shape (n,), from rest; h may vary."""
    from scipy.signal import lfilter

    decay = float(np.exp(-np.median(h) / tau))
    return np.asarray(lfilter([0.0, 1.0], [1.0, -decay], push))


def _resistance_step(c: Context) -> Iterator[Basis]:
    m = c.motion
    if "voltage" not in c.residual:
        return
    for k in step_instants(c.residual["voltage"], m.i):

        def start(b: F64, at: float = float(m.t[k])) -> dict[str, float]:
            return {"dR": b[0], "t_R": at}

        yield Basis("resistance_step", (c.voltage(f"step i {k}", np.where(m.t >= m.t[k], m.i, 0.0)),), start, 2)


def _eccentricity(c: Context) -> Iterator[Basis]:
    angle = c.motion.at_sample["position_rad"]

    def start(b: F64) -> dict[str, float] | None:
        size, phi = phase(b[0], b[1])
        return {"e_enc": size, "phi_enc": phi} if size < _MOST_ECCENTRIC else None

    shown = [{"position_rad": wave, "velocity_rad_s": rate * c.motion.at_sample["velocity_rad_s"]}
             for wave, rate in ((np.sin(angle), np.cos(angle)), (np.cos(angle), -np.sin(angle)))]  # fmt: skip
    columns = tuple(c.add(f"eccentric {k}", Trace(shown=s)) for k, s in enumerate(shown))
    yield Basis("encoder_eccentricity", columns, start, 2)


def _current_offset(c: Context) -> Iterator[Basis]:
    one = np.ones(len(c.motion.t))
    trace = Trace(shown={"current_A": one}) if "L" in c.motion.p else Trace(torque=c.motion.p["K"] * one)
    yield Basis("current_sensor_offset", (c.add("i0", trace),), lambda b: {"i0": b[0]}, 1)


def _current_gain(c: Context) -> Iterator[Basis]:
    current = c.motion.at_sample["current_A"]
    trace = Trace(shown={"current_A": current}) if "L" in c.motion.p else Trace(torque=c.motion.p["K"] * current)

    def start(b: F64) -> dict[str, float] | None:
        # With J and B free a gain of 2 explains any torque, by an inertia and a friction of nothing.
        return {"g_i": 1 + b[0]} if abs(b[0]) < _MOST_GAIN else None

    yield Basis("current_sensor_gain", (c.add("g_i", trace),), start, 1)


def _delay(c: Context) -> Iterator[Basis]:
    m = c.motion
    rates = {"position_rad": -m.at_sample["velocity_rad_s"], "velocity_rad_s": -m.omega_rate}
    if "L" in m.p:
        rates["current_A"] = -m.at_sample["current_A_rate"]
    late = {channel: Trace(shown={channel: rate}) for channel, rate in rates.items() if channel in c.channels}
    for channel, trace in late.items():

        def start(b: F64, channel: str = channel) -> dict[str, float | str] | None:
            return {"t_d": b[0], "channel": channel} if positive(b[0]) else None

        yield Basis("measurement_delay", (c.add(f"late {channel}", trace),), start, 2)


def _lag(c: Context) -> Iterator[Basis]:
    m = c.motion
    voltage = "L" in m.p
    for tau in _LAGS_S:

        def start(b: F64, tau: float = float(tau)) -> dict[str, float] | None:
            return {"t_lag": tau * b[0]} if positive(b[0]) and b[0] < 5 else None

        change = np.diff(m.u, prepend=m.u[0])
        distance = change + np.exp(-m.h / tau) * _relaxed(change, m.h, float(tau))  # u − lagged at the sample
        behind = distance * tau / m.h * -np.expm1(-m.h / tau)
        trace = Trace(voltage=behind) if voltage else Trace(torque=behind * m.p.get("K", 1.0))
        yield Basis("drive_lag", (c.add(f"lag {tau}", trace),), start, 1)


def _speed_filter(c: Context) -> Iterator[Basis]:
    if "velocity_rad_s" not in c.channels:
        return
    m = c.motion
    speed = m.at_sample["velocity_rad_s"]
    for tau in _LAGS_S:

        def start(b: F64, tau: float = float(tau)) -> dict[str, float] | None:
            return {"t_f": tau * b[0]} if positive(b[0]) and b[0] < 5 else None

        change = np.diff(speed, prepend=speed[0])  # half a step ago, on average
        behind = -np.exp(-m.h / (2 * tau)) * (change + np.exp(-m.h / tau) * _relaxed(change, m.h, float(tau)))
        yield Basis("speed_filter", (c.add(f"filter {tau}", Trace(shown={"velocity_rad_s": behind})),), start, 1)


#: What needs a voltage as input, what a current signal or K, what anything.
WINDING: dict[str, Family] = {
    "winding_heating": _heating,
    "resistance_step": _resistance_step,
}
CURRENT: dict[str, Family] = {
    "torque_ripple": _ripple,
    "magnetic_saturation": _saturation,
    "current_sensor_offset": _current_offset,
    "current_sensor_gain": _current_gain,
}
SENSORS: dict[str, Family] = {
    "encoder_eccentricity": _eccentricity,
    "measurement_delay": _delay,
    "drive_lag": _lag,
    "speed_filter": _speed_filter,
}
