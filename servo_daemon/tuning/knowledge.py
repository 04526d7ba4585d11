"""What is known of a motor, and of the loop around it, when gains are to be found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from servo_daemon.plant.parameters import LINEAR
from servo_daemon.samples import F64

#: What the loop's equations need, in the order of all arrays in here.
NEEDED: tuple[str, ...] = tuple(p.name for p in LINEAR)
UNITS: Mapping[str, str] = {p.name: p.unit for p in LINEAR}

#: Where a value comes from: the drive's estimate, the configuration, a capture's estimate, `--fix`.
Source = Literal["estimate", "nominal", "capture", "fixed"]

#: Probability content of the region over which margins are the worst.
PROBABILITY = 0.95


@dataclass(frozen=True, slots=True)
class Known:
    """One parameter. `std` is 1 σ in its SI unit, None where nothing is claimed; `why`: why it is not an estimate."""

    value: float
    source: Source
    std: float | None = None
    why: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MotorKnowledge:
    """The motor as it is.

    Attributes:
        parameters: R, L, K, J, B; each there.
        uncertain: names of those with a covariance, in the order of `covariance`.
        covariance: of their logarithms, shape (n, n), symmetric positive semi-definite.
        effects: names of the effects in the drive's model.
        extras: values of the effects' own parameters that are known, by name, SI units.
    """

    parameters: Mapping[str, Known]
    uncertain: tuple[str, ...] = ()
    covariance: F64 = field(default_factory=lambda: np.zeros((0, 0)))
    effects: tuple[str, ...] = ()
    extras: Mapping[str, float] = field(default_factory=dict)

    @property
    def log_values(self) -> F64:
        """shape (5,), in the order of `NEEDED`."""
        return np.log([self.parameters[name].value for name in NEEDED])


@dataclass(frozen=True, slots=True)
class Ask:
    """What the user wants: one of the two, or neither (then half of what the loop can reach)."""

    bandwidth_hz: float | None = None
    settling_s: float | None = None


@dataclass(frozen=True, slots=True)
class MarginLimits:
    """Below these a loop is called weak. The defaults are what textbooks ask for at the least (Åström & Hägglund,
    *Advanced PID Control*, 2006: M_s 1.2 to 2, gain margin 2 to 5, phase margin 30 to 60°)."""

    phase_margin_deg: float = 30.0
    gain_margin_dB: float = 6.0
    sensitivity_peak: float = 2.0


@dataclass(frozen=True, slots=True)
class CascadeGains:
    """A position loop around a PI speed loop whose output is the motor's voltage; `laws.cascade` has the equations.

    Attributes:
        speed_kp_V_s_rad, speed_ki_V_rad: of the speed loop.
        position_kp_1_s, position_ki_1_s2, position_kd: of the position loop; kp None: there is only the speed loop.
        setpoint_weight: b, share of the wanted speed that the proportional part sees.
        filter_hz: cut-off of the low-pass behind the difference of encoder angles; None: no filter.
    """

    speed_kp_V_s_rad: float
    speed_ki_V_rad: float = 0.0
    position_kp_1_s: float | None = None
    position_ki_1_s2: float = 0.0
    position_kd: float = 0.0
    setpoint_weight: float = 1.0
    filter_hz: float | None = None


@dataclass(frozen=True, slots=True)
class LoopSetup:
    """The loop around the motor.

    Attributes:
        rate_hz: samples a second of the controller.
        rate_source: where that comes from, for the report: "configured", "measured", "given", "assumed".
        delay_samples: from the reading of the encoder to the change of the voltage, in samples.
        in_use: the gains that the drive has now, where they are known.
        filter_hz: cut-off of the speed's low-pass in what is designed; None: ten times the loop's own speed.
        limits: below them a margin is called weak.
        voltage_V: what the drive can give, ±; None: not known.
        counts_per_rev: of the encoder; None: not known.
    """

    rate_hz: float
    rate_source: str = "given"
    delay_samples: float = 1.0
    in_use: CascadeGains | None = None
    filter_hz: float | None = None
    limits: MarginLimits = MarginLimits()
    voltage_V: float | None = None
    counts_per_rev: float | None = None

    @property
    def period_s(self) -> float:
        return 1.0 / self.rate_hz


def named(log_values: F64) -> dict[str, float]:
    """Parameters by name from their logarithms, shape (5,)."""
    return {name: math.exp(x) for name, x in zip(NEEDED, log_values, strict=True)}
