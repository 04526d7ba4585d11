"""What moves: a motor, a motion and instruments of the field, drawn by a seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tests.recovery.calibration.motors import motor as drawn_motor
from tests.recovery.generator import (
    BELT_SERVO,
    MOTORS,
    EffectValues,
    Motion,
    Motor,
    Plan,
    Scenario,
    Sensors,
    generate,
)
from tests.recovery.generator.native import F64

#: Seeds of everything here: those of the matrix are below, see `hidden.DRAWN`; a test's own are small numbers.
SEEDS = range(2**43, 2**44)
_NAMED = (*MOTORS.values(), BELT_SERVO)
#: Motors besides the named ones.
_DRAWN = 10_000
_SECONDS = 8.0
#: Motions on which all five parameters show with voltage, current and angle.
RICH = ("multisine", "prbs", "pick_and_place", "reversals", "steps")


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Columns in SI units, shape (n,) each, and what is true of the motor."""

    motor: Motor
    t: F64
    v: F64
    i: F64
    x: F64
    w: F64
    counts_per_rev: float
    truth: Mapping[str, float]

    @property
    def counts(self) -> F64:
        """Of the encoder."""
        return np.asarray(np.round(self.x / (2 * np.pi) * self.counts_per_rev))

    def part(self, index: F64 | slice) -> Run:
        """Some of the samples."""
        columns = {name: getattr(self, name)[index] for name in ("t", "v", "i", "x", "w")}
        return Run(self.motor, **columns, counts_per_rev=self.counts_per_rev, truth=self.truth)


@dataclass(frozen=True, slots=True)
class Draw:
    """The same seed is the same motor and the same random numbers."""

    seed: int
    rng: np.random.Generator = field(init=False, repr=False, compare=False)
    motor: Motor = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        named = rng.random() < 0.4
        motor = _NAMED[rng.integers(len(_NAMED))] if named else drawn_motor(int(rng.integers(_DRAWN)))
        object.__setattr__(self, "rng", rng)
        object.__setattr__(self, "motor", motor)

    def one(self, options: Sequence[float]) -> float:
        return float(self.rng.choice(options))

    def sensors(self) -> Sensors:
        """Of a hobby bench up to a good drive: current noise of 0.3 to 2 %, converters of 10 or 12 bits."""
        m, bits = self.motor, self.rng.choice([10, 12])
        return Sensors(
            current_noise_A=float(self.rng.uniform(0.003, 0.02)) * m.rated_current_A,
            current_lsb_A=2 * m.current_limit_A / 2**bits,
            voltage_lsb_V=2 * m.supply_V / 2**12,
            counts_per_rev=m.counts_per_rev,
            jitter_s=20e-6,
            stamp_lsb_s=1e-6,
            hidden_V=float(self.rng.uniform(0.0005, 0.004)) * m.supply_V,
        )

    def run(
        self,
        motion: str | Motion | Plan | None = None,
        *,
        seconds: float = _SECONDS,
        rate_hz: float | None = None,
        effects: Mapping[str, EffectValues] | None = None,
        motor: Motor | None = None,
        sensors: Sensors | None = None,
    ) -> Run:
        """One capture; None: drawn. Speed as a tacho shows it, with noise of 0.2 % of full speed."""
        motor = motor or self.motor
        sensors = sensors or self.sensors()
        motion = motion or RICH[self.rng.integers(len(RICH))]
        rate_hz = rate_hz or self.one((200.0, 500.0, 1000.0))
        hidden = dict(effects or {})
        made = generate(
            motor,
            Scenario(motion, seconds, rate_hz, effects=hidden, sensors=sensors, seed=int(self.rng.integers(2**31))),
        )
        noise = self.rng.normal(0.0, 2e-3 * motor.speed_max_rad_s, len(made.time_s))
        truth = {name: float(getattr(motor, name)) for name in ("R", "L", "K", "J", "B")}
        for values in hidden.values():
            truth |= {name: float(value) for name, value in values.items() if not isinstance(value, str)}
        columns = {"t": made.time_s, "v": made.voltage_V, "i": made.current_A, "x": made.position_rad}
        speed = made.truth.speed_rad_s + noise
        return Run(motor, **columns, w=speed, counts_per_rev=sensors.counts_per_rev, truth=truth)


def pulses(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Open loop: voltages of either sign, 50 to 400 ms long, two in seven of them zero."""
    rate_hz = (len(time_s) - 1) / (time_s[-1] - time_s[0])
    volts = np.zeros(len(time_s))
    begin = 0
    while begin < len(volts):
        end = begin + max(1, int(rng.uniform(0.05, 0.4) * rate_hz))
        volts[begin:end] = 0.6 * motor.supply_V * rng.choice([0, 0, 0.3, 0.5, -0.4, 0.7, -0.7])
        begin = end
    return Plan("voltage", volts)


def held_steps(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Open loop: every 0.1 s another voltage up to the rated current, as for a blocked-rotor test."""
    level = rng.uniform(-1.0, 1.0, round(float(time_s[-1]) / 0.1) + 2) * motor.R * motor.rated_current_A
    return Plan("voltage", level[(time_s / 0.1).astype(int)])


def moves_and_holds(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Position servo: a minimum-jerk move of 0.6 s to and fro every 3 s, at rest between."""
    number, within = np.divmod(time_s, 3.0)
    u = np.clip(within / 0.6, 0.0, 1.0)
    share = u**3 * (10 - 15 * u + 6 * u**2)
    span = min(0.25 * motor.working_torque_Nm / motor.J * 0.36 / 5.77, 0.2 * motor.speed_max_rad_s * 0.6 / 1.875)
    return Plan("position", span * np.where(number % 2 == 0, share, 1.0 - share))
