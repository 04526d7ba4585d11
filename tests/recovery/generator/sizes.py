"""How strong a hidden cause is: parameters for a given share of what the motor works with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from .effects import ALL, EffectValues
from .motors import Motor


@dataclass(frozen=True, slots=True)
class _Work:
    """What a share is a share of, for one motor, and where angles, signs and orders are drawn."""

    motor: Motor
    share: float
    seconds: float
    rng: np.random.Generator

    @property
    def torque(self) -> float:
        """share of the torque at rated current, N·m"""
        return self.share * self.motor.working_torque_Nm

    @property
    def voltage(self) -> float:
        """share of 40 % of the supply, V"""
        return self.share * 0.4 * self.motor.supply_V

    @property
    def speed(self) -> float:
        """the speed at which a drag has its share: 35 % of full speed, rad/s"""
        return 0.35 * self.motor.speed_max_rad_s

    @property
    def travel(self) -> float:
        """how far the servo motions go either way, rad"""
        return 0.1 * self.motor.speed_max_rad_s

    @property
    def knee_A(self) -> float:
        """the current I0 for which 1/(1 + (i/I0)²) takes the share away at the drive's limit; nearer to it the back-EMF
        falls faster with the current than R i rises, and the current runs away"""
        return self.motor.current_limit_A * math.sqrt((1 - self.share) / max(self.share, 1e-12))

    def angle(self) -> float:
        return float(self.rng.uniform(-math.pi, math.pi))

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))

    def instant(self) -> float:
        """somewhere in the middle of the capture, s"""
        return float(self.rng.uniform(0.35, 0.65)) * self.seconds

    def spring(self, J_l: float, frequency_rad_s: float) -> EffectValues:
        """second inertia with a resonance at this frequency, damped 10 %"""
        reduced = self.motor.J * J_l / (self.motor.J + J_l)
        return {"k_s": reduced * frequency_rad_s**2, "c_s": 0.2 * frequency_rad_s * reduced, "J_l": J_l}


def _heating(w: _Work) -> EffectValues:
    """The share is the rise of R in the end, reached with a third of the capture as time constant."""
    R_th = max(w.share, 1e-12) / 0.0039 / ((1 + w.share) * w.motor.R * w.motor.rated_current_A**2)
    return {"R_th": R_th, "C_th": w.seconds / 3 / R_th}


def _backlash(w: _Work) -> EffectValues:
    """The gap is what the working torque crosses in 15 ms at a share of 20 %."""
    gap = 0.5 * w.motor.working_torque_Nm / w.motor.J * 0.015**2 * w.share / 0.2
    return {"gap": gap, **w.spring(0.6 * w.motor.J, 500.0)}


_TYPICAL: Mapping[str, Callable[[_Work], EffectValues]] = {
    "coulomb_friction": lambda w: {"Tc": w.torque},
    "asymmetric_friction": lambda w: {
        "Tc": 1.25 * w.torque,
        "Tc_neg": 0.75 * w.torque,
        "B_neg": w.motor.B + 0.5 * w.torque / w.speed,
    },
    "stribeck_friction": lambda w: {"Tc": w.torque, "Ts": 1.6 * w.torque, "ws": 0.02 * w.motor.speed_max_rad_s},
    "position_dependent_friction": lambda w: {
        "Tc_slope": 5 * w.share * w.sign() / w.travel,
        "Tc_curve": 2.5 * w.share / w.travel**2,
    },
    "load_dependent_friction": lambda w: {"mu": w.share},
    "quadratic_drag": lambda w: {"c2": w.torque / w.speed**2},
    "gravity_load": lambda w: {"Tg": w.torque, "phi_g": w.angle()},
    "cogging_torque": lambda w: {"Tcog": w.torque, "n_cog": float(w.rng.integers(4, 25)), "phi_cog": w.angle()},
    "torque_ripple": lambda w: {"k_rip": w.share, "n_rip": float(w.rng.integers(4, 15)), "phi_rip": w.angle()},
    "constant_load_torque": lambda w: {"TL": w.sign() * w.torque},
    "load_torque_step": lambda w: {"dTL": w.sign() * w.torque, "t_TL": w.instant()},
    "periodic_disturbance": lambda w: {
        "Tper": w.torque,
        "f_per": float(w.rng.uniform(3.0, 20.0)),
        "phi_per": w.angle(),
    },
    "brush_voltage_drop": lambda w: {"Vb": w.voltage},
    "magnetic_saturation": lambda w: {"I_sat": w.knee_A},
    "winding_heating": _heating,
    "resistance_step": lambda w: {"dR": w.share * w.motor.R, "t_R": w.instant()},
    "backlash": _backlash,
    "shaft_compliance": lambda w: w.spring(max(2.5 * w.share, 1e-6) * w.motor.J, 2 * math.pi * 25.0),
    "encoder_eccentricity": lambda w: {"e_enc": 0.1 * w.share, "phi_enc": w.angle()},
    "current_sensor_offset": lambda w: {"i0": w.sign() * w.share * w.motor.rated_current_A},
    "current_sensor_gain": lambda w: {"g_i": 1 + w.share},
    "voltage_sensor_offset": lambda w: {"v0": w.sign() * w.voltage},
    "measurement_delay": lambda w: {
        "t_d": 0.01 * w.share,
        "channel": str(w.rng.choice(["current_A", "position_rad"])),
    },
    "drive_lag": lambda w: {"t_lag": 0.02 * w.share},
    "sector_mass": lambda w: {
        "J_sector": 2 * w.share * w.motor.J,
        "theta_sector": w.angle(),
        "width_sector": 1.5,
        "edge_sector": 0.1,
    },
    "hysteresis_spring": lambda w: {"T_hyst": w.torque, "theta_hyst": 0.02 * w.motor.speed_max_rad_s},
    "root_drag": lambda w: {"c_root": w.torque / math.sqrt(w.speed), "w_root": 0.01 * w.motor.speed_max_rad_s},
    "eddy_brake": lambda w: {"T_eddy": w.torque, "w_eddy": 0.15 * w.motor.speed_max_rad_s},
    "sticky_spot": lambda w: {"T_spot": 3 * w.torque, "theta_spot": w.angle(), "width_spot": 0.1},
    "torque_dropouts": lambda w: {"depth": min(1.0, 3 * w.share), "rate_hz": 1.5, "duration_s": 0.05},
    "inductance_saturation": lambda w: {"I_L": w.knee_A},
}


def typical(
    name: str, motor: Motor, share: float, *, seconds: float = 20.0, rng: np.random.Generator | None = None
) -> dict[str, EffectValues]:
    """A cause as `Scenario.effects`, as strong as `share`: of the torque at rated current, of 40 % of the supply, of
    the constant it bends (R; K and L at the current limit), or, where nothing of the kind fits, on a scale where 0.2 is
    clear and 0.04 faint.

    Args:
        name: one of ALL.
        share: 0 leaves the motor as it is (backlash: with its spring, without its gap).
        seconds: length of the capture: steps come in its middle, the winding warms over a third of it.
        rng: draws phases, signs and orders; None: always the same ones.

    Returns:
        {name: parameters}; `position_dependent_friction` brings a Coulomb friction of 20 % to vary.
    """
    if name not in ALL or not 0 <= share < 1:
        raise ValueError(f"no effect {name!r}, or a share of {share} that is not within 0 and 1")
    work = _Work(motor, share, seconds, np.random.default_rng(5) if rng is None else rng)
    effects: dict[str, EffectValues] = {name: dict(_TYPICAL[name](work))}
    if name == "position_dependent_friction":
        effects["coulomb_friction"] = {"Tc": 0.2 * motor.working_torque_Nm}
    return effects
