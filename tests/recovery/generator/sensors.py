"""What the instruments make of the motion: noise, steps of converters and encoder, sampling jitter, and the voltage
that the capture does not show."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .effects import EffectValues
from .motors import Motor
from .native import F64


@dataclass(frozen=True, slots=True)
class Sensors:
    """Zero means ideal.

    Attributes:
        current_noise_A: Gaussian, 1 σ.
        current_lsb_A: step of the current's converter, rounded to nearest.
        voltage_lsb_V: step of the recorded voltage, rounded to nearest; the motor gets the true one.
        counts_per_rev: of the encoder, rounded down as a counter does; the control loop sees it.
        jitter_s: of the sampling instants, Gaussian, 1 σ, cut at a quarter of the period.
        stamp_lsb_s: step of the recorded time stamps; 0: the true instants.
        hidden_V: noise of the applied voltage that is not recorded, 1 σ of each piece.
        hidden_pieces: how many independent pieces of it make a sample interval.
        pwm_hz: the voltage is switched between ± supply at about this frequency (bipolar, centre-aligned); 0: constant.
    """

    current_noise_A: float = 0.0
    current_lsb_A: float = 0.0
    voltage_lsb_V: float = 0.0
    counts_per_rev: float = 0.0
    jitter_s: float = 0.0
    stamp_lsb_s: float = 0.0
    hidden_V: float = 0.0
    hidden_pieces: int = 1
    pwm_hz: float = 0.0

    @classmethod
    def laboratory(cls, motor: Motor) -> Sensors:
        """Good instruments to suit the motor: 0.3 % of rated current noise, 14 and 12 bits, the motor's encoder."""
        return cls(
            current_noise_A=0.003 * motor.rated_current_A,
            current_lsb_A=3 * motor.current_limit_A / 2**14,
            voltage_lsb_V=2 * motor.supply_V / 2**14,
            counts_per_rev=motor.counts_per_rev,
            jitter_s=10e-6,
            stamp_lsb_s=1e-6,
            hidden_V=0.001 * motor.supply_V,
        )

    def check(self, rate_hz: float) -> None:
        """Raises ValueError: time stamps could repeat, or a count makes no sense."""
        if min(self.jitter_s, self.stamp_lsb_s, self.hidden_V, self.pwm_hz, self.counts_per_rev) < 0:
            raise ValueError("sensors: nothing may be negative")
        if self.stamp_lsb_s * rate_hz > 0.5 and self.jitter_s > 0:
            raise ValueError(f"time stamps of {self.stamp_lsb_s} s would repeat at {rate_hz} Hz with jitter")
        if self.hidden_pieces < 1:
            raise ValueError("hidden_pieces: at least 1")


def stream(seed: int, purpose: str) -> np.random.Generator:
    """Random numbers for one purpose: what is drawn for one does not move the others. The key is a hash of seed and
    purpose, the generator a counter-based Philox."""
    digest = hashlib.blake2b(f"independent generator/{purpose}/{seed}".encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))


def sample_times(sensors: Sensors, n: int, rate_hz: float, seed: int) -> F64:
    """The true sampling instants, s, shape (n,), from 0 on."""
    period = 1 / rate_hz
    jitter = np.clip(stream(seed, "jitter").normal(0.0, 1.0, n) * sensors.jitter_s, -0.25 * period, 0.25 * period)
    jitter[0] = 0.0
    return np.asarray(np.arange(n) * period + jitter)


def hidden_voltage(sensors: Sensors, n: int, seed: int) -> F64 | None:
    """What the drive adds unseen, V, shape (n, hidden_pieces); None without it."""
    if sensors.hidden_V == 0:
        return None
    return stream(seed, "hidden voltage").normal(0.0, sensors.hidden_V, (n, sensors.hidden_pieces))


def _rounded(values: F64, lsb: float) -> F64:
    return np.asarray(np.round(values / lsb) * lsb) if lsb > 0 else values


def recorded(
    sensors: Sensors, effects: Mapping[str, EffectValues], time_s: F64, output: Mapping[str, F64], seed: int
) -> dict[str, F64]:
    """The four columns of the capture from what the C code has sampled, shapes (n,)."""
    offset = float(effects.get("current_sensor_offset", {}).get("i0", 0.0))
    gain = float(effects.get("current_sensor_gain", {}).get("g_i", 1.0))
    v0 = float(effects.get("voltage_sensor_offset", {}).get("v0", 0.0))
    noise = stream(seed, "current noise").normal(0.0, 1.0, len(time_s)) * sensors.current_noise_A
    return {
        "time_s": _rounded(time_s, sensors.stamp_lsb_s),
        "voltage_V": _rounded(output["command"] + v0, sensors.voltage_lsb_V),
        "current_A": _rounded(gain * output["shown_current"] + offset + noise, sensors.current_lsb_A),
        "position_rad": output["shown_angle"],
    }


def filtered_speed(time_s: F64, speed_rad_s: F64, t_f: float) -> F64:
    """What a speed sensor with a first-order filter shows, rad/s, shape (n,): exact for a speed that runs straight
    between the samples; settled at the first one."""
    shown = np.empty_like(speed_rad_s)
    shown[0] = speed_rad_s[0]
    for k, (h, change) in enumerate(zip(np.diff(time_s), np.diff(speed_rad_s), strict=True)):
        behind = change / h * t_f  # of a speed that has risen so for long
        decay = np.exp(-h / t_f)
        shown[k + 1] = speed_rad_s[k + 1] - behind + (shown[k] - speed_rad_s[k] + behind) * decay
    return shown


def speed_over_window(time_s: F64, position_rad: F64, window_s: float) -> F64:
    """The speed as a difference of the angle over the last `window_s`, rad/s, shape (n,); the first ones over what
    there is."""
    begin = np.maximum(time_s - window_s, time_s[0])
    length = np.maximum(time_s - begin, np.finfo(float).tiny)
    shown = (position_rad - np.interp(begin, time_s, position_rad)) / length
    shown[0] = shown[1]
    return np.asarray(shown)
