"""The two balances with a model's effects, at one instant: what a simulator integrates that knows nothing of steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain

import casadi as ca

from servo_daemon.export.expressions import Language, as_text
from servo_daemon.export.model import CORE, ExportedModel, Value
from servo_daemon.parameters import LINEAR
from servo_daemon.plant import equations
from servo_daemon.plant.core import Drive
from servo_daemon.plant.dry import dry_levels
from servo_daemon.plant.effects import Signals, effects_by_name, event_times
from servo_daemon.plant.effects.base import probe

#: An event takes so long, s: a step in an expression that has a derivative.
_EVENT_S = 1e-6


def expressible(name: str) -> bool:
    """Whether an effect is a term in a balance: a second inertia, a late sensor and a lagging input are more."""
    terms = probe(effects_by_name()[name])[1]
    return terms.shaft is None and terms.lag_s is None and terms.delay is None


def rigid(model: ExportedModel, target: str) -> ExportedModel:
    """The model as it moves where its shaft is stiff: for targets that have one inertia. The effect stays among the
    effects, so that it is told.

    Raises:
        BadInputError: one of the two inertias is not known.
    """
    if all(probe(effects_by_name()[name])[1].shaft is None for name in model.effects):
        return model
    v = model.require(("J", "J_l"), target)
    both = Value(v["J"] + v["J_l"], None, model.values["J"].unit, "J + J_l, as if the shaft were stiff")
    return replace(model, values={**model.values, "J": both})


@dataclass(frozen=True)
class Balances:
    """Expressions over the symbols `t`, `u`, `i`, `omega`, `theta`, the effects' states and the parameters.

    Attributes:
        symbols: all of them.
        states: the effects' own, with their rates.
        current_rate, speed_rate: without what opposes them dry, A/s (None: the current is no state), rad/s².
        forward, backward: level of dry friction against positive and negative motion, N·m.
        dry_drop: level of a voltage that blocks the current, V.
        sensed: added to what the sensors show.
        used: parameters that occur.
    """

    symbols: tuple[ca.SX, ...]
    states: Mapping[str, ca.SX]
    current_rate: ca.SX | None
    speed_rate: ca.SX
    forward: ca.SX
    backward: ca.SX
    dry_drop: ca.SX
    load: ca.SX
    factor_K: ca.SX
    factor_R: ca.SX
    sensed: Mapping[str, ca.SX]
    used: tuple[str, ...]

    def text(self, expression: ca.SX | None, language: Language) -> str:
        return as_text(ca.SX(0) if expression is None else expression, self.symbols, language)

    def shown(self, drive: Drive, language: Language) -> tuple[str, str, str]:
        """What the sensors at the motor show of current, speed and angle."""
        current = {"voltage": "i", "current": "u", "torque": "0"}[drive]
        motor = {"current_A": current, "velocity_rad_s": "omega", "position_rad": "theta"}
        at = self.sensed
        told = [f"({me} + {self.text(at[c], language)})" if c in at else me for c, me in motor.items()]
        return told[0], told[1], told[2]


def balances(model: ExportedModel) -> Balances:
    """Of the effects that are terms; those that are not are left out (`expressible`)."""
    effects = [effects_by_name()[name] for name in model.effects if expressible(name)]
    names = [*CORE[model.drive], *(p.name for e in effects for p in e.parameters)]
    given = {name: ca.SX.sym(name) for name in dict.fromkeys(names)}
    # Effects may refer to what this input hides (R without a voltage): as in the plant.
    p = {q.name: ca.SX(q.nominal) for q in LINEAR} | given
    t, u, i, omega, theta, h = (ca.SX.sym(n) for n in ("t", "u", "i", "omega", "theta", "h"))
    own = {s.name: ca.SX.sym(s.name) for s in chain.from_iterable(e.states for e in effects)}
    voltage = model.drive == "voltage"
    current = i if voltage else (u if model.drive == "current" else ca.SX(0))
    signals = Signals(
        t=t, v=u if voltage else ca.SX(0), i=current, i_square=current**2, omega=omega, theta=theta,
        torque=u if model.drive == "torque" else p["K"] * current, h=h, states=own, p=p,
    )  # fmt: skip
    terms = [effect.terms(signals) for effect in effects]
    R, K, B = p["R"], p["K"], p["B"]
    load = drop = dry_drop = ca.SX(0)
    for term in terms:
        R, K, B = R * term.factor_R, K * term.factor_K, B * term.factor_B
        load, drop, dry_drop = load + term.load_torque, drop + term.voltage_drop, dry_drop + term.dry_drop
    for term in terms:
        B = B + term.viscous
    forward, backward = dry_levels(terms)
    push, factor = (u, ca.SX(1)) if model.drive == "torque" else (current, K)
    sensed: dict[str, ca.SX] = {}
    for term in terms:
        for channel, added in term.sensed.items():
            sensed[channel] = sensed.get(channel, ca.SX(0)) + added
    found = Balances(
        symbols=(t, u, i, omega, theta, *own.values(), *given.values()),
        states={name: rate for term in terms for name, rate in term.rates.items()},
        current_rate=equations.current_rate(u - drop, i, omega, R, p["L"], K) if voltage else None,
        speed_rate=equations.speed_rate(push, omega, load, factor, p["J"], B),
        forward=forward, backward=backward, dry_drop=dry_drop if voltage else ca.SX(0), load=load,
        factor_K=K / p["K"], factor_R=R / p["R"], sensed=sensed, used=tuple(dict.fromkeys(names)),
    )  # fmt: skip
    instant = 0.0 if not any(q in names for q in event_times()) else _EVENT_S
    return _with_length(found, h, instant)


def _with_length(found: Balances, h: ca.SX, seconds: float) -> Balances:
    """Of steps so short that the means over them are the values at an instant."""

    def short(expression: ca.SX) -> ca.SX:
        return ca.simplify(ca.substitute(ca.SX(expression), h, ca.SX(seconds)))

    return Balances(
        symbols=found.symbols,
        states={name: short(rate) for name, rate in found.states.items()},
        current_rate=None if found.current_rate is None else short(found.current_rate),
        speed_rate=short(found.speed_rate), forward=short(found.forward), backward=short(found.backward),
        dry_drop=short(found.dry_drop), load=short(found.load), factor_K=short(found.factor_K),
        factor_R=short(found.factor_R), sensed={n: short(e) for n, e in found.sensed.items()}, used=found.used,
    )  # fmt: skip
