"""The library of effects: one file each, named as in the contract."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module

from servo_daemon.plant.effects.base import Effect, Signals, State, Terms
from servo_daemon.plant.parameters import J_M, LINEAR, Parameter

__all__ = ["NAMES", "Effect", "Signals", "State", "Terms", "effects_by_name", "parameter_table"]

#: Order of the ladder: simpler causes first.
NAMES = (
    "coulomb_friction",
    "asymmetric_friction",
    "constant_load_torque",
    "gravity_load",
    "winding_heating",
    "current_sensor_offset",
)


@cache
def effects_by_name() -> Mapping[str, Effect]:
    """Every effect there is, by name, in the order of the ladder."""
    return {name: import_module(f"{__name__}.{name}").EFFECT for name in NAMES}


@cache
def parameter_table() -> Mapping[str, Parameter]:
    """Every parameter a configuration may name: the linear motor's, J_m, and all effects'."""
    table = {p.name: p for p in (*LINEAR, J_M)}
    for effect in effects_by_name().values():
        table.update({p.name: p for p in effect.parameters})
    return table
