"""The models a plan is made for: effects, what is free in them, and several sets of values that may be true."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servo_daemon.errors import BadInputError, ConfigError
from servo_daemon.experiment.limits import Limits
from servo_daemon.kalman.gaussian import coordinates_of
from servo_daemon.parameters import MOTOR_NAMES, Parameter
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.samples import F64

#: What a motor works with as a share of its limits: torque and current, voltage, speed.
_WORKING = 0.5
#: An effect of which no size is known has about this share of what the motor works with.
_FAINT = 0.05
#: How far values may be off, 1 σ of their logarithm: the motor's, an effect's.
_MOTOR_STD, _EFFECT_STD = 0.15, 0.4
#: What is known before, 1 σ of the logarithm (of an effect's parameter: of its size): keeps a design of few blocks
#: regular and decides nothing where they tell more.
_MOTOR_PRIOR, _EFFECT_PRIOR = 0.5, 2.0


@dataclass(frozen=True)
class Model:
    """A motor with effects, and how well it is known.

    Attributes:
        plant: the model.
        free: names of the parameters that a fit would find.
        draws: values in natural units, the nominal ones first: a plan is to be good for all of them.
        sizes: what the motor works with, as `Scale.product` takes it.
    """

    plant: PlantModel
    free: tuple[str, ...]
    draws: tuple[Mapping[str, float], ...]
    sizes: Mapping[str, float]

    @property
    def effects(self) -> tuple[str, ...]:
        return self.plant.effects

    @cached_property
    def columns(self) -> list[int]:
        """Places of the free parameters among the plant's."""
        return [self.plant.parameter_names.index(n) for n in self.free]

    @cached_property
    def units(self) -> F64:
        """One unit of each free coordinate, shape (k,): 1 for a logarithm, else the parameter's typical size."""
        table = {p.name: p for p in self.plant.parameters}
        return np.array([1.0 if table[n].transform == "log" else _size(table[n], self.sizes) for n in self.free])

    @cached_property
    def prior(self) -> F64:
        """Information before any sample, shape (k,), in those units."""
        return np.array([1.0 / (_MOTOR_PRIOR if n in MOTOR_NAMES else _EFFECT_PRIOR) ** 2 for n in self.free])

    def coordinates(self, values: Mapping[str, float]) -> F64:
        """Shape (np,)."""
        return coordinates_of(self.plant.parameters, values)


def make_model(
    effects: tuple[str, ...],
    known: Mapping[str, float],
    fixed: Sequence[str],
    limits: Limits,
    seconds: float,
    draws: int,
    seed: int,
) -> Model:
    """A model about what is known of it.

    Args:
        known: values in natural units; R, L, K, J, B must be there, an effect's parameters may.
        fixed: names that a fit would hold.
        draws: how many sets of values, the nominal one included.

    Raises:
        BadInputError: a value of the motor is missing, or there is no such model.
    """
    check_motor(known)
    try:
        plant = build_plant(effects)
    except ConfigError as error:
        raise BadInputError(str(error)) from error
    sizes = working_sizes(known, limits, seconds)
    nominal = {p.name: _value(p, known, sizes) for p in plant.parameters}
    rng = np.random.default_rng(seed)
    others = [_drawn(plant.parameters, nominal, known, rng) for _ in range(draws - 1)]
    free = tuple(p.name for p in plant.parameters if p.name not in fixed and p.held != "always")
    return Model(plant, free, (nominal, *others), sizes)


def check_motor(known: Mapping[str, float]) -> None:
    """That the motor is known at all.

    Raises:
        BadInputError: R, L, K, J or B is missing.
    """
    if missing := [n for n in MOTOR_NAMES if n not in known]:
        raise BadInputError(
            f"a plan needs the motor's {', '.join(missing)}: give it in [drive.nominal] or with --fix, from the "
            "datasheet or a first `servo-daemon fit`"
        )


def working_sizes(motor: Mapping[str, float], limits: Limits, seconds: float) -> dict[str, float]:
    """What the motor typically works with within its limits, for `Scale.product`."""
    travel = limits.travel_rad if math.isfinite(limits.travel_rad) else _WORKING * limits.velocity_rad_s
    return {
        "torque": _WORKING * motor["K"] * limits.current_A,
        "current": _WORKING * limits.current_A,
        "voltage": _WORKING * limits.voltage_V,
        "speed": _WORKING * limits.velocity_rad_s,
        "travel": travel,
        "seconds": seconds,
        **{name: motor[name] for name in ("R", "J", "B")},
    }


def _size(p: Parameter, sizes: Mapping[str, float]) -> float:
    """Of a signed parameter, natural units."""
    if p.scale is not None:
        return p.scale.product(sizes)
    of_unit = {"N·m": "torque", "A": "current", "V": "voltage", "Ω": "R"}
    return sizes[of_unit[p.unit]] if p.unit in of_unit else 1.0


def _value(p: Parameter, known: Mapping[str, float], sizes: Mapping[str, float]) -> float:
    if p.name in known:
        return known[p.name]
    if p.held == "always":
        return p.nominal
    if p.scale is not None and p.scale.share:
        value = p.scale.share * p.scale.product(sizes)
    elif p.transform == "log":
        gain = 1 + _FAINT if p.name == "g_i" else 1.0
        value = _FAINT * sizes["torque"] if p.unit == "N·m" else gain * p.nominal
    else:
        value = p.nominal if p.unit == "rad" else p.nominal + _FAINT * _size(p, sizes)
    return float(np.clip(value, p.lower, p.upper))


def _drawn(
    parameters: Sequence[Parameter],
    nominal: Mapping[str, float],
    known: Mapping[str, float],
    rng: np.random.Generator,
) -> dict[str, float]:
    """Values that may as well be true; where nothing is known of an angle, any."""
    out = {}
    for p in parameters:
        value, deviation = nominal[p.name], float(rng.standard_normal())
        if p.held == "always" or p.unit == "s":
            drawn = value
        elif p.unit == "rad" and p.transform == "identity":
            drawn = value if p.name in known else float(rng.uniform(-math.pi, math.pi))
        elif p.name in MOTOR_NAMES:
            drawn = value * math.exp(_MOTOR_STD * deviation)
        elif p.name == "g_i":
            drawn = 1.0 + (value - 1.0) * math.exp(_EFFECT_STD * deviation)
        else:
            drawn = value * math.exp(_EFFECT_STD * deviation)
        out[p.name] = float(np.clip(drawn, p.lower, p.upper))
    return out
