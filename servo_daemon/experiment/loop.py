"""A servo around the motor, for plans that are a speed or an angle: which voltage acts when it follows them.

PI control of the speed on the voltage, and around it proportional control of the angle; speed and angle as they are:

    v = k_p (ω* − ω) + z,  ż = k_i (ω* − ω);   for an angle ω* = k_θ (θ* − θ)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

import casadi as ca
import numpy as np

from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

Reference = Literal["voltage", "velocity", "position"]


@dataclass(frozen=True, slots=True)
class ServoGains:
    """Of the loop: V·s/rad, V/rad, 1/s."""

    speed_kp_V_s_rad: float
    speed_ki_V_rad: float
    position_kp_1_s: float

    @property
    def bandwidth_hz(self) -> float:
        """About how fast the position loop is; the speed loop of `suitable_gains` is four times as fast."""
        return self.position_kp_1_s / (2 * math.pi)


def suitable_gains(motor: Mapping[str, float], rate_hz: float) -> ServoGains:
    """Gains for a motor of which none are configured: the PI zero cancels the mechanical pole; the speed loop keeps
    clear of the sampling and of the winding's time constant, and the position loop is four times slower."""
    R, L, K, J, B = (motor[name] for name in MOTOR_NAMES)
    braking = R * B + K * K
    time_constant_s, volts_per_speed = J * R / braking, braking / K
    bandwidth = min(2 * math.pi * rate_hz / 40, 0.3 * R / L, 3 / time_constant_s)
    return ServoGains(bandwidth * time_constant_s * volts_per_speed, bandwidth * volts_per_speed, bandwidth / 4)


def servo_voltage(
    plant: PlantModel, values: F64, x0: F64, gains: ServoGains, kind: Reference, reference: F64, rate_hz: float
) -> F64:
    """The voltage at every sample, shape (n,), unlimited.

    Args:
        values: shape (np,), natural units.
        x0: shape (nx,), the plant's state at the first sample.
        reference: shape (n,), rad/s or rad.
    """
    constants = np.array(
        [
            gains.speed_kp_V_s_rad,
            gains.speed_ki_V_rad,
            gains.position_kp_1_s,
            float(kind == "position"),
            1.0 / rate_hz,
            *values,
        ]
    )
    rows = np.column_stack([np.arange(len(reference)) / rate_hz, reference])
    return _loop(plant).run(np.append(x0, 0.0), constants, rows)[:, 0]


@cache
def _loop(plant: PlantModel) -> SampleLoop:
    n = len(plant.states)
    state, row = ca.SX.sym("state", n + 1), ca.SX.sym("row", 2)
    constants = ca.SX.sym("constants", 5 + len(plant.parameters))
    x, z = state[:n], state[n]
    kp, ki, k_angle, angle, h = (constants[k] for k in range(5))
    omega, theta = (x[plant.state_names.index(name)] for name in ("velocity_rad_s", "position_rad"))
    error = ca.if_else(angle > 0, k_angle * (row[1] - theta), row[1]) - omega
    v = kp * error + z
    x_next = plant.step(x, v, constants[5:], row[0], h)
    step = ca.Function("step", [state, constants, row], [ca.vertcat(x_next, z + ki * h * error), v])
    return SampleLoop(step)
