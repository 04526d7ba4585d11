"""Composition: the two balances and the chosen effects become one frozen `PlantModel` with one step function.

One step over h (any h, jitter included) with the input held:

1. The linear core, with R, K and B as the effects scale them at the predicted midpoint, by its exact exponential
   (twice where they depend on the motion, whose midpoint is only known after a first guess).
2. Smooth effect torques and voltage drops as constants over the step, evaluated at the midpoint of the first guess
   (second order, as Strang splitting, but with one exponential).
3. Dry friction last, as the constant torque that would bring the speed to zero at the end of the step, limited to its
   level (Moreau's time stepping; Acary & Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*, 2008, ch. 10).
   It sticks exactly, slides exactly, needs no substeps however small h is, and its derivatives are those of the
   regime it is in. `docs/decisions.md` says why this replaced the smooth tanh.
4. The effects' own states, each by an exponential Rosenbrock step at the midpoint.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal

import casadi as ca

from servo_daemon.errors import ConfigError
from servo_daemon.plant import equations, flow
from servo_daemon.plant.effects import Effect, Signals, State, Terms, effects_by_name
from servo_daemon.plant.parameters import LINEAR, Parameter

#: What is held over a step and drives the model. Without a voltage signal the measured current is the input.
Drive = Literal["voltage", "current", "torque"]

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
    "voltage": ("R", "L", "K", "J", "B"),
    "current": ("K", "J", "B"),
    "torque": ("J", "B"),
}


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
    """

    effects: tuple[str, ...]
    drive: Drive
    parameters: tuple[Parameter, ...]
    states: tuple[State, ...]
    step: ca.Function
    sensed: ca.Function
    noise_gain: ca.Function

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.states)

    @cached_property
    def content_hash(self) -> str:
        """Changes when the equations do: part of the key of everything that is cached or persisted."""
        text = "\n".join(f.serialize() for f in (self.step, self.sensed, self.noise_gain))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class _Core:
    """The linear core over one step: x_next as an affine function of input and load torque."""

    free: ca.SX  # x_next for zero input and zero load torque
    per_input: ca.SX
    per_load: ca.SX


def _voltage_core(x: ca.SX, p: Mapping[str, ca.SX], h: ca.SX) -> _Core:
    """(i, ω, θ) by the 2 × 2 exponential; A and b are derivatives of the balances, not written again."""
    i, omega, v, tau = (ca.SX.sym(n) for n in ("i", "omega", "v", "tau"))
    rates = ca.vertcat(
        equations.current_rate(v, i, omega, p["R"], p["L"], p["K"]),
        equations.speed_rate(i, omega, tau, p["K"], p["J"], p["B"]),
    )
    Z = ca.jacobian(rates, ca.vertcat(i, omega)) * h
    b = ca.jacobian(rates, ca.vertcat(v, tau)) * h
    exp, phi1, phi2 = flow.phi_matrix(Z)
    electromechanical = x[:2]
    free = ca.vertcat(flow.apply(exp, Z, electromechanical), x[2] + h * flow.apply(phi1, Z, electromechanical)[1])
    gains = [ca.vertcat(flow.apply(phi1, Z, b[:, k]), h * flow.apply(phi2, Z, b[:, k])[1]) for k in range(2)]
    return _Core(free, gains[0], gains[1])


def _mechanical_core(x: ca.SX, p: Mapping[str, ca.SX], h: ca.SX, torque_per_input: ca.SX) -> _Core:
    """(ω, θ) with the motor torque held."""
    omega, tau = ca.SX.sym("omega"), ca.SX.sym("tau")
    rate = equations.speed_rate(ca.SX(0), omega, tau, ca.SX(0), p["J"], p["B"])
    exp, phi1, phi2 = flow.phi_scalar(ca.jacobian(rate, omega) * h)
    per_load = ca.jacobian(rate, tau) * h * ca.vertcat(phi1, h * phi2)
    free = ca.vertcat(exp * x[0], x[1] + h * phi1 * x[0])
    return _Core(free, -torque_per_input * per_load, per_load)


@dataclass(frozen=True)
class _Builder:
    """Holds the symbols while the step is put together."""

    drive: Drive
    effects: tuple[Effect, ...]
    states: tuple[State, ...]
    p: Mapping[str, ca.SX]

    @property
    def n_core(self) -> int:
        return len(_CORE_STATES[self.drive])

    def terms(self, x: ca.SX, u: ca.SX, t: ca.SX) -> list[Terms]:
        voltage = self.drive == "voltage"
        signals = Signals(
            t=t,
            v=u if voltage else ca.SX(0),
            i=x[0] if voltage else (u if self.drive == "current" else ca.SX(0)),
            omega=x[self.n_core - 2],
            theta=x[self.n_core - 1],
            states={s.name: x[self.n_core + k] for k, s in enumerate(self.states[self.n_core :])},
            p=self.p,
        )
        return [effect.terms(signals) for effect in self.effects]

    def core(self, x: ca.SX, terms: Sequence[Terms], h: ca.SX) -> _Core:
        p = dict(self.p)
        for term in terms:
            if "R" in p:
                p["R"] = p["R"] * term.factor_R
            if "K" in p:
                p["K"] = p["K"] * term.factor_K
            p["B"] = p["B"] * term.factor_B
        if self.drive == "voltage":
            return _voltage_core(x, p, h)
        return _mechanical_core(x, p, h, p["K"] if self.drive == "current" else ca.SX(1))

    def step(self, x: ca.SX, u: ca.SX, t: ca.SX, h: ca.SX) -> tuple[ca.SX, _Core]:
        n = self.n_core
        own_middle = self._own_states(x, u, t, h / 2)
        ahead = self.terms(ca.vertcat(x[: n - 1], x[n - 1] + h / 2 * x[n - 2], own_middle), u, t + h / 2)
        core = self.core(x, ahead, h)
        guess = core.free + core.per_input * (u - _drop(ahead)) + core.per_load * _load(ahead)
        middle_x = ca.vertcat((x[:n] + guess) / 2, own_middle)
        middle = self.terms(middle_x, u, t + h / 2)
        if self._factors_follow_motion():
            core = self.core(x, middle, h)
        x_next = core.free + core.per_input * (u - _drop(middle)) + core.per_load * _load(middle)
        forward, backward = _dry_levels(middle)
        if not (forward.is_zero() and backward.is_zero()):
            stopping = -x_next[n - 2] / core.per_load[n - 2]
            x_next = x_next + core.per_load * ca.fmax(ca.fmin(stopping, forward), -backward)
        return ca.vertcat(x_next, self._own_states(ca.vertcat(middle_x[:n], x[n:]), u, t + h / 2, h)), core

    def _factors_follow_motion(self) -> bool:
        """Whether R, K or B as scaled depends on current, speed or angle, whose midpoint needs a guess."""
        x, n = ca.SX.sym("x", len(self.states)), self.n_core
        terms = self.terms(x, ca.SX(0), ca.SX(0))
        factors = ca.vertcat(*[ca.SX(f) for term in terms for f in (term.factor_R, term.factor_K, term.factor_B)])
        return bool(terms) and bool(ca.depends_on(factors, x[:n]))

    def _own_states(self, x: ca.SX, u: ca.SX, t: ca.SX, h: ca.SX) -> ca.SX:
        """The effects' states after h, from those in x, with the motion in x taken as constant over h."""
        # Symbols of their own, so that the slope is the partial one: a midpoint current depends on these states too.
        at = ca.SX.sym("at", x.numel())
        rates = {name: rate for term in self.terms(at, u, t) for name, rate in term.rates.items()}
        updates = []
        for k, state in enumerate(self.states[self.n_core :], start=self.n_core):
            _, phi1, _ = flow.phi_scalar(ca.jacobian(rates[state.name], at[k]) * h)
            updates.append(at[k] + h * phi1 * rates[state.name])
        return ca.substitute(ca.vertcat(*updates), at, x) if updates else ca.SX(0, 1)

    def sensed(self, x: ca.SX, t: ca.SX) -> ca.SX:
        n = self.n_core
        shown = {
            "current_A": x[0] if self.drive == "voltage" else ca.SX(0),
            "velocity_rad_s": x[n - 2],
            "position_rad": x[n - 1],
        }
        for term in self.terms(x, ca.SX(0), t):
            for name, error in term.sensed.items():
                if name in shown:
                    shown[name] = shown[name] + error
        return ca.vertcat(*shown.values())


def _drop(terms: Sequence[Terms]) -> ca.SX:
    return sum((ca.SX(term.voltage_drop) for term in terms), start=ca.SX(0))


def _load(terms: Sequence[Terms]) -> ca.SX:
    return sum((ca.SX(term.load_torque) for term in terms), start=ca.SX(0))


def _dry_levels(terms: Sequence[Terms]) -> tuple[ca.SX, ca.SX]:
    """Sum of the dry friction levels against positive and against negative motion."""
    levels = [term.dry_levels for term in terms]
    forward, backward = (sum((ca.SX(level[k]) for level in levels), start=ca.SX(0)) for k in range(2))
    return forward, backward


def _collect(effects: Sequence[Effect], drive: Drive) -> tuple[Parameter, ...]:
    """Core parameters, then the effects' own, a shared one (Tc) once."""
    parameters = {p.name: p for p in LINEAR if p.name in _CORE_PARAMETERS[drive]}
    for effect in effects:
        for p in effect.parameters:
            parameters.setdefault(p.name, p)
    return tuple(parameters.values())


@cache
def build_plant(effects: tuple[str, ...] = (), drive: Drive = "voltage") -> PlantModel:
    """The motor with these effects, driven by this signal.

    Raises:
        ConfigError: an effect of that name does not exist or is named twice, or two of them bring Tc.
    """
    known = effects_by_name()
    for name in effects:
        if name not in known:
            raise ConfigError(f"unknown effect '{name}': known are {', '.join(known)}")
    if len(set(effects)) != len(effects):
        raise ConfigError(f"an effect is named twice: {', '.join(effects)}")
    chosen = tuple(known[name] for name in effects)
    rubbing = [name for name in effects if any(p.name == "Tc" for p in known[name].parameters)]
    if len(rubbing) > 1:
        raise ConfigError(f"{' and '.join(rubbing)} are the same dry friction Tc: a model has one of them")
    parameters = _collect(chosen, drive)
    states = _CORE_STATES[drive] + tuple(s for effect in chosen for s in effect.states)

    x, p = ca.SX.sym("x", len(states)), ca.SX.sym("p", len(parameters))
    u, t, h = ca.SX.sym("u"), ca.SX.sym("t"), ca.SX.sym("h")
    # Every parameter has a symbol, also one that this input hides (R without a voltage): effects may refer to it.
    by_name = {q.name: ca.SX(q.nominal) for q in LINEAR} | {q.name: p[k] for k, q in enumerate(parameters)}
    builder = _Builder(drive, chosen, states, by_name)
    x_next, core = builder.step(x, u, t, h)
    gain = ca.horzcat(core.per_input, core.per_load)
    padded = ca.vertcat(gain, ca.SX.zeros(len(states) - builder.n_core, 2))
    return PlantModel(
        effects=effects,
        drive=drive,
        parameters=parameters,
        states=states,
        step=ca.Function("step", [x, u, p, t, h], [x_next], ["x", "u", "p", "t", "h"], ["x_next"]),
        sensed=ca.Function("sensed", [x, p, t], [builder.sensed(x, t)], ["x", "p", "t"], ["shown"]),
        noise_gain=ca.Function("noise_gain", [x, u, p, t, h], [padded], ["x", "u", "p", "t", "h"], ["gain"]),
    )
