"""Motions to calibrate with: the same kinds of drives, none of the generator's own motions or parameters of theirs."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.signal import lfilter

from tests.recovery.generator import Motion, Motor, Plan
from tests.recovery.generator.native import F64


def chirps(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Open loop: a sine that runs from 0.2 Hz to past the mechanical corner and back, again and again, its size
    breathing, on a slow offset."""
    span_s = float(rng.uniform(4.0, 7.0))
    top = max(3.0, 3.0 / (2 * math.pi * motor.time_constant_s))
    up = np.abs(np.mod(2 * time_s / span_s + rng.uniform(), 2.0) - 1.0)
    phase = 2 * math.pi * np.cumsum(0.2 * (top / 0.2) ** up) * float(time_s[1] - time_s[0])
    size = 0.32 + 0.14 * np.sin(2 * math.pi * time_s / rng.uniform(1.3, 2.1))
    offset = 0.12 * np.sin(2 * math.pi * time_s / rng.uniform(5.0, 9.0) + rng.uniform(0.0, 6.0))
    fits = min(1.0, 0.8 * motor.R * motor.current_limit_A / (0.46 * motor.supply_V))
    return Plan("voltage", fits * motor.supply_V * (size * np.sin(phase) + offset))


def trapezoids(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Position servo: moves with a trapezoidal speed between places of a grid, pauses of 0.15 to 0.6 s."""
    speed, acceleration = 0.42 * motor.speed_max_rad_s, 0.55 * motor.working_torque_Nm / motor.J
    out, place, start = np.empty(len(time_s)), 0.0, float(time_s[0])
    while start <= time_s[-1]:
        target = float(rng.choice(np.linspace(-0.11, 0.11, 7))) * motor.speed_max_rad_s
        way = abs(target - place)
        ramp_s = min(speed / acceleration, math.sqrt(way / acceleration)) if way else 0.0
        top = acceleration * ramp_s
        whole_s = way / top + ramp_s if way else 0.0
        pause_s = float(rng.uniform(0.15, 0.6))
        here = (time_s >= start) & (time_s < start + whole_s + pause_s)
        t = np.clip(time_s[here] - start, 0.0, whole_s)
        rising, falling = np.minimum(t, ramp_s), np.clip(t - (whole_s - ramp_s), 0.0, None)
        travelled = 0.5 * acceleration * (rising**2 - falling**2) + top * (t - rising)
        out[here] = place + math.copysign(1.0, target - place) * travelled
        place, start = target, start + whole_s + pause_s
    return Plan("position", out)


def wander(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Speed servo: a random walk that is drawn back to nothing, smoothed, up to about half of the full speed."""
    step_s = float(time_s[1] - time_s[0])
    raw = _smoothed(_smoothed(rng.normal(size=len(time_s)), step_s / 0.35), step_s / 0.08)
    return Plan("speed", 0.26 * motor.speed_max_rad_s * np.clip(raw / max(float(raw.std()), 1e-12), -2.2, 2.2))


def staircase(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Speed servo: levels of random size and direction, each reached by a ramp of 0.1 s and held 0.4 to 1.2 s, now and
    then none at all."""
    count = int(time_s[-1] - time_s[0]) * 3 + 3
    ends = time_s[0] + np.cumsum(rng.uniform(0.4, 1.2, size=count))
    levels = rng.choice([-1.0, 0.0, 1.0], p=[0.42, 0.16, 0.42], size=count) * rng.uniform(0.03, 0.5, size=count)
    knots = np.column_stack([ends, ends + 0.1]).ravel()
    reached = [*np.repeat(levels, 2)[1:].tolist(), 0.0]
    return Plan("speed", motor.speed_max_rad_s * np.interp(time_s, knots, reached))


def _smoothed(x: F64, share: float) -> F64:
    """First-order lag, forwards; share: of the way to the input in a sample."""
    return np.asarray(lfilter([share], [1.0, share - 1.0], x))


MOTIONS: Mapping[str, Motion] = {
    "chirps": chirps,
    "trapezoids": trapezoids,
    "wander": wander,
    "staircase": staircase,
}
#: Those that stay within some turns.
BOUNDED = ("trapezoids",)
