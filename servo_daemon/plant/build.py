"""Composition: the two balances and the chosen effects become one frozen `PlantModel`; `step.py` makes its step."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import casadi as ca

from servo_daemon.parameters import LINEAR, MOTOR_NAMES, Parameter
from servo_daemon.plant.core import Drive
from servo_daemon.plant.dry import dry_levels
from servo_daemon.plant.effects import Effect, State, check_effects, effects_by_name
from servo_daemon.plant.effects.base import LATE
from servo_daemon.plant.step import StepBuilder

__all__ = ["Drive", "PlantModel", "build_plant"]

_CORE_STATES: dict[Drive, tuple[State, ...]] = {
    "voltage": (
        State("current_A", "A", 0.0, 1.0),
        State("velocity_rad_s", "rad/s", 0.0, 1.0),
        State("position_rad", "rad", 0.0, 1.0),
    ),
    "current": (State("velocity_rad_s", "rad/s", 0.0, 1.0), State("position_rad", "rad", 0.0, 1.0)),
    "torque": (State("velocity_rad_s", "rad/s", 0.0, 1.0), State("position_rad", "rad", 0.0, 1.0)),
}
_CORE_PARAMETERS: dict[Drive, tuple[str, ...]] = {
    "voltage": MOTOR_NAMES,
    "current": ("K", "J", "B"),
    "torque": ("J", "B"),
}
#: Samples further apart than this, s: dry friction that turns round between two of them is not found by a line. (With
#: 100 a second J of an RE 40 is 0.9 % and 7 standard deviations off, with 200 nothing.)
_LONG_S = 0.007
#: A free run cuts such samples into pieces of this length at most, s (with 5 ms an RE 40 at 20 Hz ended in a minimum
#: 224 standard deviations away; shorter ones cost as much again: docs/benchmarks.md), and a filter's step, which is
#: compiled with its parts, has so many (a friction's speed is ten times as exact).
_PIECE_S, _PARTS = 0.0025, 4
#: And so many at least, an even number, where it shows the mean of a current over each, by Simpson's rule: L comes out
#: 0.2 % short of a winding of 0.15 samples, 0.7 % of 0.1, and 3 % of 0.05, where the residual tells it.
_OF_A_MEAN = 8


@dataclass(frozen=True, eq=False)  # `build_plant` makes each model once: it is its own key in caches
class PlantModel:
    """A motor with its effects.

    Attributes:
        effects: names, in the order given.
        drive: which signal is the input.
        parameters: R, L, K, J, B (as far as the input shows them), then the effects' own.
        states: core states, then the effects'.
        step: CasADi function (x, u, p, t, h) -> x_next; x (n,), u scalar input, p (np,) natural units, t and h in s.
        sensed: CasADi function (x, p, t) -> (current_A, velocity_rad_s, position_rad) as the sensors show them;
            current is 0 where the input is not voltage.
        noise_gain: CasADi function (x, u, p, t, h) -> (n, 2): d x_next / d input and / d load torque.
        may_stick: there is dry friction, which may hold the shaft.
        parts: into how many a step is split at least.
        pieces: into how many a free run cuts each sample: as exact as parts, and nothing more to compile.
        mean_current: a free run shows the current's mean over the interval that ends at each sample.
    """

    effects: tuple[str, ...]
    drive: Drive
    parameters: tuple[Parameter, ...]
    states: tuple[State, ...]
    step: ca.Function
    sensed: ca.Function
    noise_gain: ca.Function
    may_stick: bool
    parts: int = 1
    pieces: int = 1
    mean_current: bool = False

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.states)

    def with_effects(self, effects: tuple[str, ...]) -> PlantModel:
        """The same motor with these effects instead, cut as finely."""
        return _in_pieces(build_plant(effects, self.drive, self.parts), self.pieces, self.mean_current)

    def for_runs_of(self, period_s: float, *, mean_current: bool = False) -> PlantModel:
        """For free runs over samples so far apart. (What a late sensor keeps is counted in samples.)"""
        if any(s in LATE for s in self.states):
            return self
        pieces = math.ceil(period_s / _PIECE_S) if self._turns_within(period_s) else 1
        if mean_current:
            pieces = max(pieces + pieces % 2, _OF_A_MEAN)
        return _in_pieces(self, pieces, mean_current)

    def for_filter_of(self, period_s: float) -> PlantModel:
        """For a filter over samples so far apart."""
        return build_plant(self.effects, self.drive, _PARTS if self._turns_within(period_s) else 1)

    def _turns_within(self, period_s: float) -> bool:
        return self.may_stick and period_s > _LONG_S

    @cached_property
    def content_hash(self) -> str:
        """Changes when the equations do: part of the key of everything that is cached or persisted."""
        text = "\n".join(f.serialize() for f in (self.step, self.sensed, self.noise_gain))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _collect(effects: Sequence[Effect], drive: Drive) -> tuple[Parameter, ...]:
    """Core parameters, then the effects' own, a shared one (Tc) once."""
    parameters = {p.name: p for p in LINEAR if p.name in _CORE_PARAMETERS[drive]}
    for effect in effects:
        for p in effect.parameters:
            parameters.setdefault(p.name, p)
    return tuple(parameters.values())


def build_plant(effects: tuple[str, ...] = (), drive: Drive = "voltage", parts: int = 1) -> PlantModel:
    """The motor with these effects, driven by this signal.

    Args:
        parts: see `PlantModel`.

    Raises:
        ConfigError: see `check_effects`.
    """
    return _built(effects, drive, parts)


@cache
def _in_pieces(plant: PlantModel, pieces: int, mean_current: bool) -> PlantModel:
    if (pieces, mean_current) == (plant.pieces, plant.mean_current):
        return plant
    return replace(plant, pieces=pieces, mean_current=mean_current)


@cache
def _built(effects: tuple[str, ...], drive: Drive, parts: int) -> PlantModel:
    check_effects(effects)
    chosen = tuple(effects_by_name()[name] for name in effects)
    parameters = _collect(chosen, drive)
    states = _CORE_STATES[drive] + tuple(s for effect in chosen for s in effect.states)

    x, p = ca.SX.sym("x", len(states)), ca.SX.sym("p", len(parameters))
    u, t, h = ca.SX.sym("u"), ca.SX.sym("t"), ca.SX.sym("h")
    # Every parameter has a symbol, also one that this input hides (R without a voltage): effects may refer to it.
    by_name = {q.name: ca.SX(q.nominal) for q in LINEAR} | {q.name: p[k] for k, q in enumerate(parameters)}
    builder = StepBuilder(drive, chosen, states, len(_CORE_STATES[drive]), by_name, parts)
    x_next, gain = builder.step(x, u, t, h)
    return PlantModel(
        effects=effects,
        drive=drive,
        parameters=parameters,
        states=states,
        step=ca.Function("step", [x, u, p, t, h], [x_next], ["x", "u", "p", "t", "h"], ["x_next"]),
        sensed=ca.Function("sensed", [x, p, t], [builder.sensed(x, t)], ["x", "p", "t"], ["shown"]),
        noise_gain=ca.Function("noise_gain", [x, u, p, t, h], [gain], ["x", "u", "p", "t", "h"], ["gain"]),
        may_stick=not all(level.is_zero() for level in dry_levels(builder.terms(x, u, t, h))),
        parts=parts,
    )
