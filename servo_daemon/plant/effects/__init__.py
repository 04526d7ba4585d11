"""The library of effects: one file each, found by being here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from pkgutil import iter_modules

import casadi as ca

from servo_daemon.errors import ConfigError
from servo_daemon.parameters import J_M, LINEAR, Parameter
from servo_daemon.plant.effects.base import Effect, Signals, State, Terms, probe

__all__ = [
    "Effect",
    "Signals",
    "State",
    "Terms",
    "check_effects",
    "dry_frictions",
    "effects_by_name",
    "event_times",
    "further_harmonics",
    "parameter_table",
    "unknown_effect",
]


@cache
def effects_by_name() -> Mapping[str, Effect]:
    """Every effect there is, by name, in the order of the ladder, then by name of its file.

    Raises:
        ImportError: a file of this folder has no effect, or one whose name or parameter is another's.
    """
    found: list[Effect] = []
    for file in sorted(m.name for m in iter_modules(__path__) if m.name != "base"):
        module = import_module(f"{__name__}.{file}")
        effects = getattr(module, "EFFECTS", None) or (getattr(module, "EFFECT", None),)
        found += [effect for effect in effects if isinstance(effect, Effect)]
        if len(effects) != sum(isinstance(effect, Effect) for effect in effects):
            raise ImportError(f"{module.__file__}: no effect: give it EFFECT = Effect(...)")
    table = {p.name: p for p in (*LINEAR, J_M)}
    out: dict[str, Effect] = {}
    for effect in sorted(found, key=lambda effect: effect.ladder):
        if effect.name in out:
            raise ImportError(f"{__path__[0]}: two effects are called {effect.name}: rename one")
        out[effect.name] = effect
        for p in effect.parameters:
            if table.setdefault(p.name, p) != p:
                where = f"{__path__[0]}: {effect.name}"
                raise ImportError(f"{where}: its parameter {p.name} is another's, too, and not the same: rename it")
    for effect in out.values():
        _check_names(effect, out, table)
    return out


def _check_names(effect: Effect, known: Mapping[str, Effect], table: Mapping[str, Parameter]) -> None:
    """Raises ImportError: it names what is no effect or no parameter."""
    columns = effect.regressors
    beside = (columns.beside,) if columns is not None and columns.beside else ()
    for name in (*effect.told_from, *(n for instead in effect.simpler for n in instead), *beside):
        if name not in known:
            raise ImportError(f"{__path__[0]}: {effect.name} names {name}, which is no effect")
    gives = (c.gives for c in (*columns.shaft, *columns.armature)) if columns is not None else ()
    of = {**effect.phases, **effect.share_of}
    concerned = (n for by in (effect.hides, effect.never_sure) for own, others in by.items() for n in (own, *others))
    for name in (*gives, *of, *filter(None, (effect.late, *of.values())), *concerned):
        if name not in table:
            raise ImportError(f"{__path__[0]}: {effect.name} names {name}, which is no parameter")


@cache
def dry_frictions() -> tuple[str, ...]:
    """Effects that are a dry friction of their own."""
    terms = {name: probe(effect)[1] for name, effect in effects_by_name().items()}
    return tuple(n for n, t in terms.items() if any(not ca.SX(level).is_zero() for level in t.dry_levels))


@cache
def event_times() -> Mapping[str, str]:
    """What steps, and the parameter that says when: a time that no filter finds along the way."""
    out: dict[str, str] = {}
    for effect in effects_by_name().values():
        at = [p.name for p in effect.parameters if p.held == "live" and p.unit == "s"]
        if len(at) == 1:
            out |= {p.name: at[0] for p in effect.parameters if p.held == "no"}
    return out


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


def unknown_effect(name: str) -> str:
    """What is said of a name that no effect has."""
    from servo_daemon.config_hints import did_you_mean

    known = effects_by_name()
    return f"unknown effect '{name}'{did_you_mean(name, known)}: known are {', '.join(known)}"


def check_effects(names: Sequence[str]) -> None:
    """That a model can have these effects together.

    Raises:
        ConfigError: one does not exist or is named twice, two of them bring the same parameters, or one is nothing
            without another that is missing.
    """
    known = effects_by_name()
    for name in names:
        if name not in known:
            raise ConfigError(unknown_effect(name))
    if len(set(names)) != len(names):
        raise ConfigError(f"an effect is named twice: {', '.join(names)}")
    for parameter, what in (("Tc", "the same dry friction Tc"), ("J_l", "the same second inertia J_l")):
        sharing = [name for name in names if any(p.name == parameter for p in known[name].parameters)]
        if len(sharing) > 1:
            raise ConfigError(f"{' and '.join(sharing)} are {what}: a model has one of them")
    for name in names:
        if known[name].scales_friction and not set(names) & set(dry_frictions()):
            raise ConfigError(f"{name} varies a dry friction: the model needs one of {', '.join(dry_frictions())}")
        if known[name].further and known[name].further not in names:
            raise ConfigError(f"{name} is a further harmonic of {known[name].further}: name that, too")
