"""What an effect is: a named physical cause that adds terms to the balances, states, parameters or sensor errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import casadi as ca

from servo_daemon.plant.parameters import Parameter


@dataclass(frozen=True, slots=True)
class State:
    """A state an effect brings along. `scale` is a typical size, for the filter's initial covariance and noise."""

    name: str
    unit: str
    initial: float
    scale: float


@dataclass(frozen=True, slots=True)
class Signals:
    """What an effect may depend on, as CasADi expressions: time t (s), voltage v (V), current i (A), speed omega
    (rad/s), angle theta (rad), the effects' states and all parameters by name."""

    t: ca.SX
    v: ca.SX
    i: ca.SX
    omega: ca.SX
    theta: ca.SX
    states: Mapping[str, ca.SX]
    p: Mapping[str, ca.SX]


@dataclass(frozen=True, slots=True)
class Terms:
    """What an effect adds. Absent terms are zero (factors: one).

    Attributes:
        load_torque: smooth torque added to τ_load, N·m.
        dry_friction: level of dry friction, N·m: the torque that opposes sliding and holds at rest up to that level.
        dry_friction_neg: that level against negative motion, N·m; None: the same.
        voltage_drop: subtracted from the applied voltage, V.
        factor_R, factor_K, factor_B: multiply R, K and B.
        rates: d/dt of the effect's states.
        sensed: added to what a sensor shows: "current_A", "position_rad", "voltage_V".
    """

    load_torque: ca.SX | float = 0.0
    dry_friction: ca.SX | float = 0.0
    dry_friction_neg: ca.SX | float | None = None
    voltage_drop: ca.SX | float = 0.0
    factor_R: ca.SX | float = 1.0
    factor_K: ca.SX | float = 1.0
    factor_B: ca.SX | float = 1.0
    rates: Mapping[str, ca.SX] = field(default_factory=dict)
    sensed: Mapping[str, ca.SX] = field(default_factory=dict)

    @property
    def dry_levels(self) -> tuple[ca.SX | float, ca.SX | float]:
        """Level of dry friction against positive and against negative motion, N·m."""
        return self.dry_friction, self.dry_friction if self.dry_friction_neg is None else self.dry_friction_neg


@dataclass(frozen=True, slots=True)
class Effect:
    """One effect.

    Attributes:
        name: as in configuration and JSON.
        cause: the physical cause, one sentence.
        equation: the added term, LaTeX.
        parameters: its own; names are unique over all effects, except the one shared `Tc`.
        terms: the added terms as a function of the signals.
        states: states it brings along.
    """

    name: str
    cause: str
    equation: str
    parameters: tuple[Parameter, ...]
    terms: Callable[[Signals], Terms]
    states: tuple[State, ...] = ()
