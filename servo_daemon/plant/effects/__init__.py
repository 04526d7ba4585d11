"""The library of effects: one file each, named as in the contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module

from servo_daemon.errors import ConfigError
from servo_daemon.parameters import J_M, LINEAR, Parameter
from servo_daemon.plant.effects.base import Effect, Signals, State, Terms

__all__ = [
    "NAMES",
    "Effect",
    "Signals",
    "State",
    "Terms",
    "check_effects",
    "effects_by_name",
    "further_harmonics",
    "parameter_table",
]

#: Order of the ladder: simpler causes first.
NAMES = (
    "coulomb_friction",
    "asymmetric_friction",
    "stribeck_friction",
    "load_dependent_friction",
    "position_dependent_friction",
    "quadratic_drag",
    "constant_load_torque",
    "gravity_load",
    "load_torque_step",
    "periodic_disturbance",
    "cogging_torque",
    "torque_ripple",
    "current_sensor_offset",
    "current_sensor_gain",
    "voltage_sensor_offset",
    "encoder_eccentricity",
    "brush_voltage_drop",
    "resistance_step",
    "magnetic_saturation",
    "winding_heating",
    "freewheel_drive",
    "drive_lag",
    "measurement_delay",
    "speed_filter",
    "shaft_compliance",
    "backlash",
)
#: Effects that are a dry friction of their own.
DRY = ("coulomb_friction", "asymmetric_friction", "stribeck_friction", "load_dependent_friction")
#: What steps, and the parameter that says when.
INSTANTS: Mapping[str, str] = {"dTL": "t_TL", "dR": "t_R"}


@cache
def effects_by_name() -> Mapping[str, Effect]:
    """Every effect there is, by name, in the order of the ladder."""
    modules = [import_module(f"{__name__}.{name}") for name in NAMES]
    each = [getattr(module, "EFFECTS", None) or (module.EFFECT,) for module in modules]
    return {effect.name: effect for effects in each for effect in effects}


def further_harmonics(name: str) -> tuple[str, ...]:
    """Effects that are further harmonics of this one: `cogging_torque_2`, …"""
    return tuple(n for n, effect in effects_by_name().items() if effect.further == name)


@cache
def parameter_table() -> Mapping[str, Parameter]:
    """Every parameter a configuration may name: the linear motor's, J_m, and all effects'."""
    table = {p.name: p for p in (*LINEAR, J_M)}
    for effect in effects_by_name().values():
        table.update({p.name: p for p in effect.parameters})
    return table


def check_effects(names: Sequence[str]) -> None:
    """That a model can have these effects together.

    Raises:
        ConfigError: one does not exist or is named twice, two of them bring the same parameters, or one is nothing
            without another that is missing.
    """
    known = effects_by_name()
    for name in names:
        if name not in known:
            raise ConfigError(f"unknown effect '{name}': known are {', '.join(known)}")
    if len(set(names)) != len(names):
        raise ConfigError(f"an effect is named twice: {', '.join(names)}")
    for parameter, what in (("Tc", "the same dry friction Tc"), ("J_l", "the same second inertia J_l")):
        sharing = [name for name in names if any(p.name == parameter for p in known[name].parameters)]
        if len(sharing) > 1:
            raise ConfigError(f"{' and '.join(sharing)} are {what}: a model has one of them")
    for name in names:
        if known[name].scales_friction and not set(names) & set(DRY):
            raise ConfigError(f"{name} varies a dry friction: the model needs one of {', '.join(DRY)}")
        if known[name].further and known[name].further not in names:
            raise ConfigError(f"{name} is a further harmonic of {known[name].further}: name that, too")
