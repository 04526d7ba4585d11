"""What an effect is: a named physical cause that adds terms to the balances, states, parameters or sensor errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import casadi as ca

from servo_daemon.parameters import MOTOR_NAMES, Parameter
from servo_daemon.plant.columns.regressors import Regressors, Values
from servo_daemon.plant.columns.screening import Family

#: Half angles below this: sin x/x by its series, whose next term is x⁴/120.
_SMALL_ANGLE = 1e-3


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
    (rad/s), angle theta (rad), the motor's torque (N·m), the effects' states and all parameters by name. Terms are held
    over h (s) about t; h is 0 where a sensor is asked. i_square (A²) is the mean of i² over h: a winding that settles
    within a sample has another than the square of its current in the middle."""

    t: ca.SX
    v: ca.SX
    i: ca.SX
    i_square: ca.SX
    omega: ca.SX
    theta: ca.SX
    torque: ca.SX
    h: ca.SX
    states: Mapping[str, ca.SX]
    p: Mapping[str, ca.SX]


@dataclass(frozen=True, slots=True)
class Shaft:
    """A second inertia J_l (kg·m²) behind spring k_s (N·m/rad), damper c_s (N·m·s/rad) and gap (rad; None: none). Its
    states are `TWIST`."""

    J_l: ca.SX
    k_s: ca.SX
    c_s: ca.SX
    gap: ca.SX | None = None


@dataclass(frozen=True, slots=True)
class Delay:
    """A sensor shows what was `seconds` before; `channel`: which, as a number (index into `Parameter.choices`)."""

    seconds: ca.SX
    channel: ca.SX


#: States of `Shaft`: rate of the twist (motor minus load), and the twist.
TWIST = (State("twist_rate_rad_s", "rad/s", 0.0, 1.0), State("twist_rad", "rad", 0.0, 0.1))
#: States of `Terms.lag_s`: the input as it has followed.
LAGGED = State("lagged_input", "", 0.0, 10.0)
#: How many steps back a late sensor goes.
LATE_STEPS = 7
#: States of `Delay`, of each of the last steps, the newest first: how much the late channel changed, how much another
#: one did, and the step's length (0: not known yet). Lengths are no estimates: at that scale no filter moves them.
LATE = (
    *(State(f"late_change_{k}", "", 0.0, 1.0) for k in range(LATE_STEPS)),
    *(State(f"late_other_{k}", "", 0.0, 1.0) for k in range(LATE_STEPS)),
    *(State(f"late_length_{k}", "s", 0.0, 1e-12) for k in range(LATE_STEPS)),
)


@dataclass(frozen=True, slots=True)
class Terms:
    """What an effect adds. Absent terms are zero (factors: one).

    Attributes:
        load_torque: smooth torque added to τ_load, N·m.
        dry_friction: level of dry friction, N·m: the torque that opposes sliding and holds at rest up to that level.
        dry_friction_neg: that level against negative motion, N·m; None: the same.
        factor_dry: multiplies the model's whole dry friction.
        voltage_drop: subtracted from the applied voltage, V.
        dry_drop: level of a voltage that opposes the current and blocks it up to that level, V.
        factor_R, factor_K, factor_B: multiply R, K and B.
        moment_K: first moment of factor_K over the step: mean of its change times the time from the middle, s.
        viscous: added to B, N·m·s/rad.
        rates: d/dt of the effect's states, those aside that shaft, lag and delay bring.
        sensed: added to what a sensor shows: "current_A", "position_rad", "velocity_rad_s".
        shaft: a second inertia.
        lag_s: voltage or torque as applied follow what is reported by a first-order lag, s.
        delay: a late sensor.
    """

    load_torque: ca.SX | float = 0.0
    dry_friction: ca.SX | float = 0.0
    dry_friction_neg: ca.SX | float | None = None
    factor_dry: ca.SX | float = 1.0
    voltage_drop: ca.SX | float = 0.0
    dry_drop: ca.SX | float = 0.0
    factor_R: ca.SX | float = 1.0
    factor_K: ca.SX | float = 1.0
    factor_B: ca.SX | float = 1.0
    moment_K: ca.SX | float = 0.0
    viscous: ca.SX | float = 0.0
    rates: Mapping[str, ca.SX] = field(default_factory=dict)
    sensed: Mapping[str, ca.SX] = field(default_factory=dict)
    shaft: Shaft | None = None
    lag_s: ca.SX | None = None
    delay: Delay | None = None

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
        parameters: its own; names are unique over all effects, except the one shared `Tc`, and k_s, c_s, J_l.
        terms: the added terms as a function of the signals.
        states: states it brings along.
        substeps: a step is split into so many: where the term changes much within a sample at ordinary rates.
        scales_friction: it is nothing without a dry friction in the model.
        further: the effect of which this is a further harmonic; "" if none.
        ladder: its place among the others, simpler causes first.
        simpler: what may stand in its place where a search ends, simplest first; it contains each single one of them.
        alike: by a parameter of its own, the positive one that it equals where all there is is the first of `simpler`.
        told_from: by another effect's name, the experiment that tells the two apart, in words; one of the two has it.
        kind: what it is among others that one experiment tells apart ("": nothing of them).
        screening: its shapes in what a fit leaves, over a scan of what is not linear, with start values; None: those
            that follow from its terms.
        regressors: its columns in the regressions; None: those that follow from its terms.
        phases: its phases against the angle, and the parameter that says how often they repeat in a turn ("": once).
        as_simpler: from all values, those of what stands in its place: the nearest that the simpler model has to it;
            None: with these values that is not near.
        hides: by a parameter of its own, those of which no motion shows anything while nobody has given that one: it
            trades places with them, or only a filter that begins near it sees it. One that is not among them is held.
        never_sure: by a parameter of its own, those of which a running filter cannot tell how sure it is beside it.
        late: the parameter that says by how much something is late; what is as slow leaves nearly the same trace.
        share_of: parameters that are a share ("") or, over another parameter, make one, of what the motor works with.
        exact_zero: an input of exactly zero is a command of its own: no noise is on it.
        possible: whether there is such a thing with these values.
        true_to_name: whether with these values it is what it is called; else it is something else that they fit.
    """

    name: str
    cause: str
    equation: str
    parameters: tuple[Parameter, ...]
    terms: Callable[[Signals], Terms]
    states: tuple[State, ...] = ()
    substeps: int = 1
    scales_friction: bool = False
    further: str = ""
    ladder: int = 1_000
    simpler: tuple[tuple[str, ...], ...] = ()
    alike: Mapping[str, str] = field(default_factory=dict)
    told_from: Mapping[str, str] = field(default_factory=dict)
    kind: Literal["", "friction", "angle", "event"] = ""
    screening: Family | None = None
    regressors: Regressors | None = None
    phases: Mapping[str, str] = field(default_factory=dict)
    as_simpler: Callable[[Values, Sequence[str]], Values | None] = lambda _, __: {}
    hides: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    never_sure: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    late: str = ""
    share_of: Mapping[str, str] = field(default_factory=dict)
    exact_zero: bool = False
    possible: Callable[[Values], bool] = lambda _: True
    true_to_name: Callable[[Values], bool] = lambda _: True


def probe(effect: Effect) -> tuple[Signals, Terms]:
    """Symbols of its own, and what an effect makes of them; with the motor's parameters and the dry friction Tc."""
    names = (*MOTOR_NAMES, "Tc", *(p.name for p in effect.parameters))
    scalars = ("t", "v", "i", "i_square", "omega", "theta", "torque", "h")
    signals = Signals(
        **{name: ca.SX.sym(name) for name in scalars},
        states={state.name: ca.SX.sym(state.name) for state in effect.states},
        p={name: ca.SX.sym(name) for name in dict.fromkeys(names)},
    )
    return signals, effect.terms(signals)


def mean_sine(phase: ca.SX, change: ca.SX) -> ca.SX:
    """Mean of the sine of a phase that rises evenly by `change` (rad), `phase` being its middle. However many periods
    pass in a step, none of them is mistaken for a slower one."""
    half = change / 2
    small = ca.fabs(half) < _SMALL_ANGLE
    safe = ca.if_else(small, 1.0, half)
    return ca.sin(phase) * ca.if_else(small, 1 - half * half / 6, ca.sin(safe) / safe)


def moment_of_sine(phase: ca.SX, change: ca.SX) -> ca.SX:
    """Mean of the sine times the time from the middle, as a share of the step; see `mean_sine`."""
    half = change / 2
    small = ca.fabs(half) < _SMALL_ANGLE
    safe = ca.if_else(small, 1.0, half)
    slope = ca.if_else(small, half / 6 * (1 - half * half / 10), (ca.sin(safe) / safe - ca.cos(safe)) / (2 * safe))
    return ca.cos(phase) * slope


def share_after(t: ca.SX, h: ca.SX, event: ca.SX) -> ca.SX:
    """Share of the time from t − h/2 to t + h/2 that lies after the event, 0 … 1: a step with a derivative."""
    return ca.fmin(ca.fmax((t - event) / h + 0.5, 0.0), 1.0)
