"""What the drive is made to do: references for the control loop in C, or a voltage in open loop.

Every motion scales with the motor: currents stay near its rated current, speeds below its speed without load. A motion
is a function (motor, time_s, rng) -> Plan; `MOTIONS` names the five there are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .motors import Motor
from .native import F64

Mode = Literal["voltage", "speed", "position"]
_MODES: Mapping[Mode, float] = {"voltage": 0.0, "speed": 1.0, "position": 2.0}


@dataclass(frozen=True, slots=True)
class Gains:
    """PI speed control on the voltage, proportional position control around it.

    Attributes:
        kp, ki: V·s/rad and V/rad.
        k_pos: 1/s.
        filter_s: of the speed from encoder differences.
        speed_limit_rad_s: of the speed reference.
    """

    kp: float
    ki: float
    k_pos: float
    filter_s: float
    speed_limit_rad_s: float


def servo_gains(motor: Motor, rate_hz: float) -> Gains:
    """Gains for the motor as it is named: the PI zero cancels the mechanical pole, the position loop is four times
    slower. The bandwidth keeps clear of the sampling and of the winding's time constant."""
    bandwidth = min(2 * math.pi * rate_hz / 40, 0.3 * motor.R / motor.L, 3 / motor.time_constant_s)
    gain = motor.speed_max_rad_s / motor.supply_V
    return Gains(
        kp=bandwidth * motor.time_constant_s / gain,
        ki=bandwidth / gain,
        k_pos=bandwidth / 4,
        filter_s=max(0.2 / bandwidth, 1e-6),
        speed_limit_rad_s=0.8 * motor.speed_max_rad_s,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A motion, ready to run.

    Attributes:
        mode: what `reference` is: V, rad/s or rad.
        reference: shape (n,), held from each sample to the next.
        added_V: shape (n,): added to the controller's voltage (dither), recorded as a part of it.
        gains: of the loop; None: `servo_gains`.
    """

    mode: Mode
    reference: F64
    added_V: F64 | float = 0.0
    gains: Gains | None = None

    def setup(self, motor: Motor, rate_hz: float) -> dict[str, float]:
        """The loop as fields of the C code's Setup."""
        gains = self.gains or servo_gains(motor, rate_hz)
        return {
            "mode": _MODES[self.mode],
            "kp": gains.kp,
            "ki": gains.ki,
            "k_pos": gains.k_pos,
            "filter_s": gains.filter_s,
            "speed_limit": gains.speed_limit_rad_s,
            "supply_V": motor.supply_V,
            "current_limit": motor.current_limit_A,
            "R_nominal": motor.R,
            "L_nominal": motor.L,
        }


Motion = Callable[[Motor, F64, np.random.Generator], Plan]


def multisine(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Open loop: 24 sines of random frequency from 0.15 Hz to past the electrical corner, so that nothing repeats.

    Sizes in proportion to 1/|admittance|^½ keep speed and current both busy, up to 85 % of the rated current (RMS of
    the linear motor) or 90 % of the supply (peak), whichever comes first.
    """
    top = max(2.0, min(0.2 * _rate_hz(time_s), 1.5 * motor.R / motor.L / (2 * math.pi)))
    tones = 0.15 * (top / 0.15) ** ((np.arange(24) + rng.uniform(size=24)) / 24)
    phases = rng.uniform(0.0, 2 * math.pi, 24)
    s = 2j * math.pi * tones
    admittance = np.abs((motor.J * s + motor.B) / ((motor.L * s + motor.R) * (motor.J * s + motor.B) + motor.K**2))
    sizes = admittance**-0.5
    voltage = np.zeros(len(time_s))
    for size, tone, phase in zip(sizes, tones, phases, strict=True):
        voltage += size * np.sin(2 * math.pi * tone * time_s + phase)
    current_rms = math.sqrt(0.5 * float(np.sum((sizes * admittance) ** 2)))
    scale = min(0.85 * motor.rated_current_A / current_rms, 0.9 * motor.supply_V / float(np.abs(voltage).max()))
    return Plan("voltage", scale * voltage)


def prbs(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Open loop: a random telegraph signal, held 0.02–0.4 s, on ramps between random levels, 1–3 s long."""
    swing = min(0.3 * motor.supply_V, 0.45 * motor.R * motor.current_limit_A)
    sign = _held(time_s, rng, 0.02, 0.4, lambda count: rng.choice([-1.0, 1.0], size=count))
    knots = np.cumsum(rng.uniform(1.0, 3.0, size=int(time_s[-1] - time_s[0]) + 3)) - 1.0
    level = np.interp(time_s - time_s[0], knots, rng.uniform(-0.4, 0.4, size=len(knots)) * motor.supply_V)
    return Plan("voltage", swing * sign + level)


def steps(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Position servo: steps to random places, held until the servo has settled and up to three times as long."""
    span = 0.05 * motor.speed_max_rad_s
    settled_s = max(0.3, 4.0 / servo_gains(motor, _rate_hz(time_s)).k_pos)
    places = _held(time_s, rng, settled_s, 3 * settled_s, lambda count: rng.uniform(-span, span, size=count))
    return Plan("position", places)


def reversals(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Speed servo: slow triangles through zero (7 s at up to 8 % of full speed), then a ramp to 55 % and back, either
    way (5 s)."""
    top = motor.speed_max_rad_s
    phase = rng.uniform(0.0, 12.0)
    within = np.mod(time_s + phase, 12.0)
    slow = 0.08 * top * _triangle(within / 3.5)
    fast = 0.55 * top * _triangle((within - 7.0) / 5.0)
    return Plan("speed", np.where(within < 7.0, slow, fast))


def pick_and_place(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Position servo: minimum-jerk moves between random places, dwells of 0.1–0.5 s."""
    top, acceleration = 0.5 * motor.speed_max_rad_s, 0.7 * motor.working_torque_Nm / motor.J
    reference = np.empty(len(time_s))
    start, place = time_s[0], 0.0
    while start <= time_s[-1]:
        target = rng.uniform(-0.15, 0.15) * motor.speed_max_rad_s
        # peaks of the minimum-jerk move: 15/8 of the mean speed, 10/sqrt(3) of distance / duration²
        distance = abs(target - place)
        duration = max(1.875 * distance / top, math.sqrt(5.7735 * distance / acceleration), 0.05)
        end = start + duration + rng.uniform(0.1, 0.5)
        here = (time_s >= start) & (time_s < end)
        u = np.clip((time_s[here] - start) / duration, 0.0, 1.0)
        reference[here] = place + (target - place) * u**3 * (10 - 15 * u + 6 * u**2)
        start, place = end, target
    return Plan("position", reference)


MOTIONS: Mapping[str, Motion] = {
    "multisine": multisine,
    "steps": steps,
    "reversals": reversals,
    "pick_and_place": pick_and_place,
    "prbs": prbs,
}


@dataclass(frozen=True, slots=True)
class Start:
    """State at the first sample."""

    current_A: float = 0.0
    speed_rad_s: float = 0.0
    position_rad: float = 0.0
    load_speed_rad_s: float = 0.0
    load_position_rad: float | None = field(default=None)  # None: as the motor's
    winding_rise_K: float = 0.0

    def setup(self) -> dict[str, float]:
        """As fields of the C code's Setup."""
        load = self.position_rad if self.load_position_rad is None else self.load_position_rad
        return {
            "start_current": self.current_A,
            "start_speed": self.speed_rad_s,
            "start_angle": self.position_rad,
            "start_load_speed": self.load_speed_rad_s,
            "start_load_angle": load,
            "start_rise": self.winding_rise_K,
        }


def _rate_hz(time_s: F64) -> float:
    return float((len(time_s) - 1) / (time_s[-1] - time_s[0]))


def _held(time_s: F64, rng: np.random.Generator, least_s: float, most_s: float, draw: Callable[[int], F64]) -> F64:
    """Random values, each held for a random time."""
    count = int((time_s[-1] - time_s[0]) / least_s) + 2
    ends = time_s[0] + np.cumsum(rng.uniform(least_s, most_s, size=count))
    return np.asarray(draw(count))[np.searchsorted(ends, time_s, side="right")]


def _triangle(turns: F64) -> F64:
    """Period 1, from 0 up to 1, down to -1, back to 0."""
    return np.asarray(2 / math.pi * np.arcsin(np.sin(2 * math.pi * turns)))
