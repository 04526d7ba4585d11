"""What effects add to the regressions, as their files say it (`Effect.regressors`) or as it follows from their terms.

`coefficient` says how a column's coefficient follows from the parameters, `as_parameters` the way back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from servo_daemon.plant.columns.regressors import Column, Derived, itself
from servo_daemon.plant.contribution import contribution
from servo_daemon.plant.effects import effects_by_name, parameter_table
from servo_daemon.regression.columns.derived_terms import DerivedTerms, derived_terms
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64


def derived_of(effects: Sequence[str]) -> tuple[DerivedTerms, ...]:
    """Derived columns of those effects that bring none of their own."""
    return tuple(derived_terms(e) for e in effects if effects_by_name()[e].regressors is None)


def unseen_in(effects: Sequence[str], *, sees_current: bool, sees_angle: bool) -> frozenset[str]:
    """Effects that follow what is not measured: columns of zeros would keep a regression from any estimate."""
    of = {e: contribution(e) for e in effects}
    by_current = {e for e, c in of.items() if c.follows(c.signals.i, c.signals.i_square, c.signals.torque)}
    by_angle = {e for e, c in of.items() if c.follows(c.signals.theta)}
    return frozenset((set() if sees_current else by_current) | (set() if sees_angle else by_angle))


def columns_of(effect: str, effects: Sequence[str]) -> tuple[str, ...]:
    """What an effect adds to the shaft's regression.

    Args:
        effects: all there are.
    """
    own = effects_by_name()[effect].regressors
    if own is None:
        return derived_terms(effect).columns["shaft"]
    return tuple(c.name for c in own.shaft) if not own.beside or own.beside in effects else ()


def shaft_columns(effects: Sequence[str]) -> tuple[str, ...]:
    """Columns of the shaft beside J and B, in the order of the effects."""
    return tuple(column for effect in effects for column in columns_of(effect, effects))


def armature_columns(effects: Sequence[str]) -> tuple[str, ...]:
    """Beside R, L and K: the constant, then what is one column, then waves, then what follows from terms."""
    own = [r.armature for e in effects if (r := effects_by_name()[e].regressors) is not None]
    ordered = sorted(own, key=lambda columns: (not any(c.name == "one" for c in columns), len(columns)))
    named = dict.fromkeys(c.name for columns in ordered for c in columns)
    return (*named, *(c for d in derived_of(effects) for c in d.columns["armature"]))


def armature_offsets(effects: Sequence[str]) -> tuple[str, ...]:
    """Parameters that are a constant in the armature's balance."""
    return tuple(c.gives for e, c in _columns("armature") if c.name == "one" and e in effects)


def waves_per_turn(phase: str, held: Mapping[str, float]) -> float:
    """How often a wave repeats in a turn, by the name of its phase; 0 of what is no phase. Where an encoder's zero lies
    within its count nobody knows: the phase is known no better than so many times half a count."""
    for effect in effects_by_name().values():
        if phase in effect.phases:
            return held[effect.phases[phase]] if effect.phases[phase] else 1.0
    return 0.0


def given_by(column: str) -> str:
    """The parameter that a column of the shaft's regression gives."""
    return _named("shaft")[column][0].gives if column in _named("shaft") else column


def is_share(column: str) -> bool:
    """Whether the coefficient of a column is a share of the motor torque."""
    return column in _named("shaft") and _named("shaft")[column][0].share


def coefficient(column: str, value: Mapping[str, float]) -> Derived:
    """A column's coefficient in the shaft's balance (N·m or a share), and its derivatives by the estimated coordinates.

    Args:
        value: of all parameters, natural units.
    """
    return _coefficient("shaft", column, value)


def armature_coefficient(column: str, value: Mapping[str, float]) -> Derived:
    """The same in the armature's balance (V per unit of the column)."""
    found, by = _coefficient("armature", column, value)
    if not is_share(column):
        return found, by
    K = value["K"]
    return K * found, {"K": K * found, **{p: K * slope for p, slope in by.items()}}


def as_parameters(columns: Sequence[str], value: F64, covariance: F64) -> tuple[F64, F64]:
    """Coefficients as the parameters that `given_by` names, errors to first order.

    Args:
        columns: what stands behind the values; those of the armature may be among them.
        value, covariance: shapes (n,), (n, n), in natural units.
    """
    own = {name: c for name, (c, *_) in _named("shaft").items() if c.solve is not None and name in columns}
    if not own:
        return value, covariance
    out, by = value.copy(), np.eye(len(value))
    at = {name: k for k, name in enumerate(columns)}
    found = dict(zip(columns, value.tolist(), strict=True))
    for name, c in own.items():
        assert c.solve is not None
        out[at[name]], slopes = c.solve(found)
        by[at[name], at[name]] = 0.0
        for other, slope in slopes.items():
            by[at[name], at[other]] = slope
    return out, by @ covariance @ by.T


def shaft_signals(effect: str, s: Stretch, value: Mapping[str, float]) -> list[F64]:
    """What an effect's columns in the shaft's balance are the modulated integrals of, shapes (n,).

    Args:
        value: what is held, and where what is not linear is taken, natural units.
    """
    own = effects_by_name()[effect].regressors
    return derived_terms(effect).signals("shaft", s, value) if own is None else own.signals(s, value)


def _columns(which: str) -> list[tuple[str, Column]]:
    """Of the library, in its order, with the effects that bring them."""
    own = ((n, e.regressors) for n, e in effects_by_name().items() if e.regressors is not None)
    return [(n, c) for n, r in own for c in (r.shaft if which == "shaft" else r.armature)]


@cache
def _named(which: str) -> Mapping[str, list[Column]]:
    """By name, one of each parameter."""
    out: dict[str, dict[str, Column]] = {}
    for _, c in _columns(which):
        out.setdefault(c.name, {}).setdefault(c.gives, c)
    return {name: list(of.values()) for name, of in out.items()}


def _coefficient(which: str, column: str, value: Mapping[str, float]) -> Derived:
    found = _named(which).get(column)
    if found is None:
        return itself(parameter_table()[column]).coefficient(value)
    parts = [c.coefficient(value) for c in found]
    return sum(part for part, _ in parts), {p: slope for _, by in parts for p, slope in by.items()}
