"""What effects add to the regressions: columns, the signals they are integrals of, the parameters they give.

A column's coefficient is a torque (N·m), a share of the motor torque, or a voltage; `coefficient` says how it follows
from the parameters, `as_parameters` the way back. What is held in a running filter (orders, frequencies) is a constant
of the signals; a term that is not linear in what is left (`ws` of the Stribeck friction) is taken at its start value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.plant.contribution import contribution
from servo_daemon.plant.effects import parameter_table
from servo_daemon.regression.columns.derived_terms import DerivedTerms, derived_terms
from servo_daemon.regression.stretch import Stretch, speed_sign
from servo_daemon.regression.stretch import speed as speed_of
from servo_daemon.samples import F64

#: Signals of an effect's columns, from a stretch and the values that are held or begun with.
Signals = Callable[[Stretch, Mapping[str, float]], list[F64]]

#: Columns whose coefficient is a share of the motor torque.
SHARES = frozenset({"mu", "rip_sin", "rip_cos"})


@dataclass(frozen=True, slots=True)
class Wave:
    """A sine of an angle: A sin(α + φ) = (A cos φ) sin α + (A sin φ) cos α.

    Attributes:
        sine, cosine: columns.
        amplitude, phase: parameters.
    """

    sine: str
    cosine: str
    amplitude: str
    phase: str


_ENDINGS = ("", "_2", "_3", "_4")
#: By effect.
WAVES: Mapping[str, Wave] = {
    "gravity_load": Wave("sin", "cos", "Tg", "phi_g"),
    "periodic_disturbance": Wave("per_sin", "per_cos", "Tper", "phi_per"),
    "torque_ripple": Wave("rip_sin", "rip_cos", "k_rip", "phi_rip"),
    **{f"cogging_torque{e}": Wave(f"cog{e}_sin", f"cog{e}_cos", f"Tcog{e}", f"phi_cog{e}") for e in _ENDINGS},
}
#: The order of a wave, by its phase.
_ORDER_OF = {"phi_rip": "n_rip", **{f"phi_cog{e}": f"n_cog{e}" for e in _ENDINGS}}
_WAVE_OF = {column: wave for wave in WAVES.values() for column in (wave.sine, wave.cosine)}
#: Friction along the travel: the column, the parameter that it is per unit of Tc.
_ALONG = ("Tc_slope", "Tc_curve")
#: What effects add to the shaft's regression, beside waves.
_SHAFT: Mapping[str, tuple[str, ...]] = {
    "coulomb_friction": ("Tc",),
    "asymmetric_friction": ("Tc", "Tc_neg", "B_neg"),
    "stribeck_friction": ("Tc", "boundary"),
    "load_dependent_friction": ("mu",),
    "position_dependent_friction": _ALONG,
    "quadratic_drag": ("c2",),
    "constant_load_torque": ("one",),
}
#: The parameter that a column gives, where it has another name.
_GIVES: Mapping[str, str] = {
    "one": "TL",
    "boundary": "Ts",
    **{w.sine: w.amplitude for w in WAVES.values()},
    **{w.cosine: w.phase for w in WAVES.values()},
}
#: Effects without which the balances are judged: small, or no terms of theirs but errors of a sensor.
_NO_COLUMNS = frozenset(
    {
        "load_torque_step",
        "current_sensor_gain",
        "encoder_eccentricity",
        "resistance_step",
        "magnetic_saturation",
        "winding_heating",
        "freewheel_drive",
        "drive_lag",
        "measurement_delay",
        "speed_filter",
    }
)
#: Effects that are a constant in the armature's balance, and their parameters.
ARMATURE_OFFSETS = {"current_sensor_offset": "i0", "voltage_sensor_offset": "v0"}

#: Columns whose coefficient is not the parameter itself.
_CHANGED = frozenset({*(w.sine for w in WAVES.values()), "boundary", *_ALONG})


#: Effects that have their columns here, or are known to have none.
_TOLD = _NO_COLUMNS | {*WAVES, *_SHAFT, *ARMATURE_OFFSETS, "brush_voltage_drop"}


def derived_of(effects: Sequence[str]) -> tuple[DerivedTerms, ...]:
    """Of those effects that have their columns from their terms."""
    return tuple(derived_terms(e) for e in effects if e not in _TOLD)


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
    if effect in WAVES:
        return WAVES[effect].sine, WAVES[effect].cosine
    if effect == "position_dependent_friction" and "coulomb_friction" not in effects:
        return ()  # the level that varies is no single column
    return _SHAFT[effect] if effect in _SHAFT else tuple(c for d in derived_of((effect,)) for c in d.columns["shaft"])


def shaft_columns(effects: Sequence[str]) -> tuple[str, ...]:
    """Beside J and B, in the order of the effects."""
    return tuple(column for effect in effects for column in columns_of(effect, effects))


def armature_columns(effects: Sequence[str]) -> tuple[str, ...]:
    """Beside R, L and K."""
    offset = ("one",) if ARMATURE_OFFSETS.keys() & set(effects) else ()
    brushes = ("Vb",) if "brush_voltage_drop" in effects else ()
    ripple = ("rip_sin", "rip_cos") if "torque_ripple" in effects else ()
    return (*offset, *brushes, *ripple, *(c for d in derived_of(effects) for c in d.columns["armature"]))


def waves_per_turn(phase: str, held: Mapping[str, float]) -> float:
    """How often a wave repeats in a turn, by the name of its phase; 0 of what is no phase. Where an encoder's zero lies
    within its count nobody knows: the phase is known no better than so many times half a count."""
    if phase in ("phi_g", "phi_enc"):
        return 1.0
    return held[_ORDER_OF[phase]] if phase in _ORDER_OF else 0.0


def given_by(column: str) -> str:
    """The parameter that a column of the shaft's regression gives."""
    return _GIVES.get(column, column)


def coefficient(column: str, value: Mapping[str, float]) -> tuple[float, dict[str, float]]:
    """A column's coefficient in the shaft's balance (N·m or a share), and its derivatives by the estimated coordinates.

    Args:
        value: of all parameters, natural units.
    """
    if column in _WAVE_OF:
        wave = _WAVE_OF[column]
        A, phi = value[wave.amplitude], value[wave.phase]
        c, s = A * math.cos(phi), A * math.sin(phi)
        if column == wave.sine:
            return c, {wave.amplitude: c, wave.phase: -s}
        return s, {wave.amplitude: s, wave.phase: c}
    if column in _ALONG:
        Tc, share = value["Tc"], value[column]
        return Tc * share, {"Tc": Tc * share, column: Tc}
    if column == "boundary":
        return value["Ts"] - value["Tc"], {"Ts": value["Ts"], "Tc": -value["Tc"]}
    if column == "one":
        return value.get("TL", 0.0), {"TL": 1.0}
    return value[column], _by_itself(column, value)


def _by_itself(column: str, value: Mapping[str, float]) -> dict[str, float]:
    """Derivative of a parameter by its own estimated coordinate."""
    return {column: value[column] if parameter_table()[column].transform == "log" else 1.0}


def armature_coefficient(column: str, value: Mapping[str, float]) -> tuple[float, dict[str, float]]:
    """The same in the armature's balance (V per unit of the column)."""
    if column == "one":
        return value.get("v0", 0.0) - value["R"] * value.get("i0", 0.0), {"i0": -value["R"], "v0": 1.0}
    if column in SHARES:
        share, by = coefficient(column, value)
        return value["K"] * share, {"K": value["K"] * share, **{p: value["K"] * slope for p, slope in by.items()}}
    return value[column], _by_itself(column, value)


def as_parameters(columns: Sequence[str], value: F64, covariance: F64) -> tuple[F64, F64]:
    """Coefficients as the parameters that `given_by` names, errors to first order.

    Args:
        columns: what stands behind the values; those of the armature may be among them.
        value, covariance: shapes (n,), (n, n), in natural units.
    """
    if not _CHANGED.intersection(columns):
        return value, covariance
    out, by = value.copy(), np.eye(len(value))
    at = {name: k for k, name in enumerate(columns)}
    for wave in WAVES.values():
        if wave.sine in at:
            k, j = at[wave.sine], at[wave.cosine]
            c, s = value[k], value[j]
            size = max(math.hypot(c, s), 1e-300)
            out[k], out[j] = size, math.atan2(s, c)
            by[k, [k, j]], by[j, [k, j]] = (c / size, s / size), (-s / size**2, c / size**2)
    if "boundary" in at:
        out[at["boundary"]] = value[at["boundary"]] + value[at["Tc"]]
        by[at["boundary"], at["Tc"]] = 1.0
    for name in _ALONG:
        if name in at and value[at["Tc"]] != 0.0:
            k, Tc = at[name], value[at["Tc"]]
            out[k] = value[k] / Tc
            by[k, k], by[k, at["Tc"]] = 1.0 / Tc, -value[k] / Tc**2
    return out, by @ covariance @ by.T


def _asymmetric(s: Stretch, _: Mapping[str, float]) -> list[F64]:
    sign = speed_sign(s)
    return [np.maximum(sign, 0.0), np.minimum(sign, 0.0), np.minimum(speed_of(s), 0.0)]


def _stribeck(s: Stretch, value: Mapping[str, float]) -> list[F64]:
    sign = speed_sign(s)
    return [sign, sign * np.exp(-np.square(speed_of(s) / value["ws"]))]


def _effort(s: Stretch) -> F64:
    effort = s.current if s.torque is None else s.torque
    return np.zeros_like(s.time_s) if effort is None else effort


def _angle(s: Stretch) -> F64:
    return s.position if s.position is not None else np.zeros_like(s.time_s)


def _along(s: Stretch, _: Mapping[str, float]) -> list[F64]:
    sign, angle = speed_sign(s), _angle(s)
    return [sign * angle, sign * angle * angle]


def _by_angle(order: str | None) -> Signals:
    def waves(s: Stretch, value: Mapping[str, float]) -> list[F64]:
        angle = (1.0 if order is None else value[order]) * _angle(s)
        return [np.sin(angle), np.cos(angle)]

    return waves


def _by_time(s: Stretch, value: Mapping[str, float]) -> list[F64]:
    angle = 2 * math.pi * value["f_per"] * s.time_s
    return [np.sin(angle), np.cos(angle)]


def _ripple(s: Stretch, value: Mapping[str, float]) -> list[F64]:
    effort, angle = _effort(s), value["n_rip"] * _angle(s)
    return [-effort * np.sin(angle), -effort * np.cos(angle)]


#: What the shaft's columns are the modulated integrals of, by effect.
SIGNALS: Mapping[str, Signals] = {
    "coulomb_friction": lambda s, _: [speed_sign(s)],
    "asymmetric_friction": _asymmetric,
    "stribeck_friction": _stribeck,
    "load_dependent_friction": lambda s, _: [speed_sign(s) * np.abs(_effort(s))],
    "position_dependent_friction": _along,
    "quadratic_drag": lambda s, _: [speed_of(s) * np.abs(speed_of(s))],
    "constant_load_torque": lambda s, _: [np.ones_like(s.time_s)],
    "gravity_load": _by_angle(None),
    "periodic_disturbance": _by_time,
    "torque_ripple": _ripple,
    **{f"cogging_torque{e}": _by_angle(f"n_cog{e}") for e in _ENDINGS},
}


def shaft_signals(effect: str, s: Stretch, value: Mapping[str, float]) -> list[F64]:
    """What an effect's columns in the shaft's balance are the modulated integrals of, shapes (n,).

    Args:
        value: what is held, and where what is not linear is taken, natural units.
    """
    return SIGNALS[effect](s, value) if effect in SIGNALS else derived_terms(effect).signals("shaft", s, value)
