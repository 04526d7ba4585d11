"""What is known of a motor, and of the loop around it, when gains are to be found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from servo_daemon.parameters import LINEAR, MOTOR_NAMES
from servo_daemon.samples import F64

#: What the loop's equations need, in the order of all arrays in here.
NEEDED: tuple[str, ...] = MOTOR_NAMES
UNITS: Mapping[str, str] = {p.name: p.unit for p in LINEAR}

#: Where a value comes from: the drive's estimate, the configuration, a capture's estimate, `--fix`.
Source = Literal["estimate", "nominal", "capture", "fixed"]

#: Probability content of the region over which margins are the worst.
PROBABILITY = 0.95

#: A coefficient with a larger relative 1 σ has no lower limit; the region's radius for three coefficients (√χ²₀.₉₅(3)).
_SEEN, _RADIUS = 0.3, 2.795
#: No linear model knows a motor better than this (relative 1 σ of each coefficient), whatever its fit says.
_MODEL = 0.005
#: Share of viscous friction in the braking of a motor of which only the answer is known.
_NO_FRICTION = 1e-9


@dataclass(frozen=True, slots=True)
class Known:
    """One parameter. `std` is 1 σ in its SI unit, None where nothing is claimed; `why`: why it is not an estimate."""

    value: float
    source: Source
    std: float | None = None
    why: str | None = None


@dataclass(frozen=True, slots=True)
class Coefficient:
    """A coefficient of the speed's answer to the voltage, with 1 σ, SI units."""

    expression: str
    value: float
    std: float
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class MotorKnowledge:
    """The motor as it is.

    Attributes:
        parameters: R, L, K, J, B; each there.
        uncertain: names of those with a covariance, in the order of `covariance`.
        covariance: of their logarithms, shape (n, n), symmetric positive semi-definite.
        effects: names of the effects in the drive's model.
        extras: values of the effects' own parameters that are known, by name, SI units.
        answer: without a current sensor, all that is known: gain and lags of speed per voltage. Parameters and extras
            are then those of one motor with this answer, see `motor_with_answer`.
    """

    parameters: Mapping[str, Known]
    uncertain: tuple[str, ...] = ()
    covariance: F64 = field(default_factory=lambda: np.zeros((0, 0)))
    effects: tuple[str, ...] = ()
    extras: Mapping[str, float] = field(default_factory=dict)
    answer: tuple[Coefficient, ...] = ()

    @property
    def open(self) -> tuple[str, ...]:
        """Parameters of one motor of many: their values are no knowledge, and not to be published."""
        return NEEDED if self.answer else ()

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


def motor_with_answer(
    coefficients: tuple[Coefficient, ...], covariance: F64, effects: tuple[str, ...], load_V: Mapping[str, float]
) -> MotorKnowledge:
    """One motor of all those whose speed answers the voltage with g/(1 + s p + s² q): the one with 1 Ω and practically
    no viscous friction, K = 1/g, J = p/g², L = q/p. Loops that measure the angle alone are the same with all of them,
    and as the logarithms of K, J and L are linear in those of g, p and q, so is a region around them.

    Args:
        coefficients: g, p, q.
        covariance: of their relative deviations, shape (3, 3).
        load_V: torques of the effects as voltages at the standing motor, R τ/K, by parameter.
    """
    (g, p, q), covariance = _bounded([c.value for c in coefficients], covariance + _MODEL**2 * np.eye(3))
    values = {"R": 1.0, "L": q / p, "K": 1.0 / g, "J": p / g**2, "B": _NO_FRICTION / g**2}
    logs = np.array([[0.0, -1.0, 1.0], [-1.0, 0.0, 0.0], [-2.0, 1.0, 0.0]])  # of L, K, J by those of g, p, q
    return MotorKnowledge(
        parameters={name: Known(value, "capture", why="not known by itself") for name, value in values.items()},
        uncertain=("L", "K", "J"),
        covariance=logs @ covariance @ logs.T,
        effects=effects,
        extras={name: volts * values["K"] for name, volts in load_V.items()},
        answer=coefficients,
    )


def _bounded(coefficients: list[float], covariance: F64) -> tuple[list[float], F64]:
    """Of a winding that is too fast to be seen only an upper limit of q is known, two standard deviations up; it is
    then taken at half of that, and the region reaches up to all of it, which is what makes a loop late."""
    if covariance[2, 2] < _SEEN**2:
        return coefficients, covariance
    middle = 0.5 * (1.0 + 2.0 * float(np.sqrt(covariance[2, 2])))  # over the estimate
    follow = covariance[:2, 2] / covariance[2, 2]  # of g and p with q
    center = [coefficients[0], coefficients[1], coefficients[2] * middle]
    for k in range(2):
        center[k] *= 1.0 + float(follow[k]) * (middle - 1.0)
    along = np.array([*(follow * middle), 1.0])
    rest = np.zeros((3, 3))
    rest[:2, :2] = covariance[:2, :2] - np.outer(follow, follow) * covariance[2, 2]
    return center, rest + np.outer(along, along) * (np.log(2.0) / _RADIUS) ** 2


def named(log_values: F64) -> dict[str, float]:
    """Parameters by name from their logarithms, shape (5,)."""
    return {name: math.exp(x) for name, x in zip(NEEDED, log_values, strict=True)}
