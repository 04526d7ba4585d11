"""One step over h (any h, jitter included) with the input held, put together from the core and the effects' terms.

1. The linear core, with R, K and B as the effects scale them at the predicted midpoint, by its exact exponential
   (twice where they depend on the motion, whose midpoint is only known after a first guess).
2. Smooth effect torques and voltage drops as constants over the step, evaluated at the midpoint of the first guess
   (second order, as Strang splitting, but with one exponential).
3. Dry friction last (`dry.py`): it sticks exactly, slides exactly, reverses within the step, needs no substeps however
   small h is, and its derivatives are those of the regime it is in. `docs/decisions.md` says why this replaced the
   smooth tanh. The brushes' drop does the same to the current.
4. The effects' own states, each by an exponential Rosenbrock step at the midpoint; a second inertia by `shaft.py`, a
   late sensor by `delay.py`, a lagging input by its own exponential.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca

from servo_daemon.plant import flow
from servo_daemon.plant.core import Core, Drive, Turning, homogeneous, linear_core
from servo_daemon.plant.delay import Step, behind, delay_of, kept, of_channel, with_newest
from servo_daemon.plant.dry import dry_levels, friction_over_step
from servo_daemon.plant.effects import Effect, Signals, State, Terms
from servo_daemon.plant.effects.base import LAGGED, LATE, LATE_STEPS, TWIST, Delay
from servo_daemon.plant.midpoint import factors_follow_motion, guess_needs_friction
from servo_daemon.plant.shaft import TwoInertias, after_second_half, standing

#: Passes over blocked current and sticking shaft, where both may be: each moves the other by K² h²/(4 J L) at most.
_PASSES = 3


@dataclass(frozen=True)
class _Held:
    """What acts during a step: mean input and its rise across the step, and the sums of the terms."""

    u: ca.SX
    rise: ca.SX
    terms: Sequence[Terms]


@dataclass(frozen=True)
class _Solved:
    """States after the step, and the constant drop (V) and friction torque (N·m) that made them so."""

    x: ca.SX
    drop: ca.SX
    friction: ca.SX


@dataclass(frozen=True)
class StepBuilder:
    """Holds the symbols while the step is put together.

    Attributes:
        core_states: how many of the states are the core's.
        p: every parameter by name.
        parts: a step is split into so many, or into more where an effect asks for them.
    """

    drive: Drive
    effects: tuple[Effect, ...]
    states: tuple[State, ...]
    core_states: int
    p: Mapping[str, ca.SX]
    parts: int = 1

    def terms(self, x: ca.SX, u: ca.SX, t: ca.SX, h: ca.SX, i_square: ca.SX | None = None) -> list[Terms]:
        n, voltage = self.core_states, self.drive == "voltage"
        i = x[0] if voltage else (u if self.drive == "current" else ca.SX(0))
        signals = Signals(
            t=t,
            v=u if voltage else ca.SX(0),
            i=i,
            i_square=i**2 if i_square is None else i_square,
            omega=x[n - 2],
            theta=x[n - 1],
            torque=u if self.drive == "torque" else self.p["K"] * i,
            h=h,
            states={s.name: x[n + k] for k, s in enumerate(self.states[n:])},
            p=self.p,
        )
        return [effect.terms(signals) for effect in self.effects]

    def step(self, x: ca.SX, u: ca.SX, t: ca.SX, h: ca.SX) -> tuple[ca.SX, ca.SX]:
        """x after the step, and its derivatives by input and load torque, shape (n, 2)."""
        after, gain = self._parts(x, u, t, h)
        delay = delay_of(self.terms(x, u, t, h))
        return (after, gain) if delay is None else self._keep_step(x, after, gain, delay, h)

    def _parts(self, x: ca.SX, u: ca.SX, t: ca.SX, h: ca.SX) -> tuple[ca.SX, ca.SX]:
        parts = max(self.parts, *(effect.substeps for effect in self.effects), 1)
        if parts == 1:
            return self._substep(x, u, t, h)[:2]
        after, whole, length = x, ca.SX.zeros(len(self.states), 2), h / parts
        substep = self._substep_function()
        for k in range(parts):
            after, gain, through = substep(after, u, t + k * length, length, ca.vertcat(*self.p.values()))
            whole = through @ whole + gain  # what the parts before have done goes on in this one
        return after, whole

    def _substep_function(self) -> ca.Function:
        """`_substep` as a function (x, u, t, h, p) -> (x_next, gain, through)."""
        x, p = ca.SX.sym("x", len(self.states)), ca.SX.sym("p", len(self.p))
        u, t, h = ca.SX.sym("u"), ca.SX.sym("t"), ca.SX.sym("h")
        own = replace(self, p=dict(zip(self.p, ca.vertsplit(p), strict=True)))
        return ca.Function("substep", [x, u, t, h, p], list(own._substep(x, u, t, h)))

    def _substep(self, x: ca.SX, u: ca.SX, t: ca.SX, h: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """x after it, its derivatives by input and load torque, and by x as far as current, speed and angle go by
        themselves (a shaft that friction holds included)."""
        n = self.core_states
        declared = self.terms(x, u, t, h)
        mean, rise, lagged = self._input(declared, x, u, h)
        own_middle = self._own_states(x, u, t, h / 2)
        begin, z, two = self._first_half(declared, x, h)
        # After half a step through the shaft the angle is the middle's.
        angle = begin[n - 1] if two is not None else begin[n - 1] + h / 2 * begin[n - 2]
        ahead = self.terms(ca.vertcat(begin[: n - 1], angle, own_middle), u, t + h / 2, h)
        core = self._core(begin, ahead, h)
        speed = None if two is not None else begin[n - 2]
        guess = self._solved(core, _Held(mean, rise, ahead), speed, dry=guess_needs_friction(*self._probe())).x
        middle_x = ca.vertcat((begin + guess) / 2, own_middle)
        if two is not None:
            middle_x[n - 1] = angle
        middle = self.terms(middle_x, u, t + h / 2, h)
        known = ahead
        if factors_follow_motion(*self._probe()):
            known = middle
            core = self._core(begin, known, h)
        held = _Held(mean, rise, middle)
        whole = core
        if two is not None:
            moved = standing(core, begin, z)
            whole = after_second_half(two, moved, self._solved(moved, held, None).x)
        solved = self._solved(whole, held, speed)
        i_square = self._mean_square(x, held, solved, h) if self.drive == "voltage" else None
        own = self._own_states(ca.vertcat(middle_x[:n], x[n:]), u, t + h / 2, h, i_square)
        rows = dict.fromkeys(self._places((LAGGED,)), lagged)
        rows |= {place: solved.x[n + k] for k, place in enumerate(self._places(TWIST))}
        own = ca.vertcat(*[rows.get(n + k, own[k]) for k in range(own.numel())]) if rows else own
        through, at = ca.SX.eye(len(self.states)), ca.SX.sym("at", n)
        through[:n, :n] = ca.jacobian(self._core(at, known, h).free, at)
        gain = self._gain(whole, mean, u)
        for place in self._places((LAGGED,)):
            through[:n, place] = core.per_input @ ca.jacobian(mean, x)[place]
            through[place, :] = ca.jacobian(lagged, x)
            gain[place, 0] = ca.jacobian(lagged, u)
        return ca.vertcat(solved.x[:n], own), gain, through

    def _places(self, states: Sequence[State]) -> list[int]:
        return [self.states.index(s) for s in states if s in self.states]

    def _gain(self, core: Core, mean: ca.SX, u: ca.SX) -> ca.SX:
        gain = ca.horzcat(core.per_input, core.per_load)
        if mean is not u:
            gain[:, 0] *= ca.jacobian(mean, u)
        n, out = self.core_states, ca.SX.zeros(len(self.states), 2)
        for row, place in enumerate([*range(n), *self._places(TWIST)]):
            out[place, :] = gain[row, :]
        return out

    def _input(self, declared: Sequence[Terms], x: ca.SX, u: ca.SX, h: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Mean of what acts over the step, its rise across it (least squares), and the lagged input at its end."""
        lag = next((term.lag_s for term in declared if term.lag_s is not None), None)
        if lag is None:
            return u, ca.SX(0), u
        behind = x[self._places((LAGGED,))[0]] - u
        if self.drive == "current":  # it is measured, not commanded
            return u, ca.SX(0), u
        exp, phi1, phi2 = flow.phi_scalar(-h / lag)
        return u + behind * phi1, 12 * behind * (phi1 / 2 - phi2), u + behind * exp

    def _first_half(self, declared: Sequence[Terms], x: ca.SX, h: ca.SX) -> tuple[ca.SX, ca.SX, TwoInertias | None]:
        """Core states and twist after half a step through the shaft, where there is a second inertia."""
        shaft = next((term.shaft for term in declared if term.shaft is not None), None)
        begin = x[: self.core_states]
        if shaft is None:
            return begin, ca.SX(0, 1), None
        two = TwoInertias(shaft, self.p["J"], h / 2)
        z = x[self._places(TWIST)]
        return *two.over_half(begin, z, two.meeting(z), inhomogeneous=True), two

    def _core(self, x: ca.SX, terms: Sequence[Terms], h: ca.SX) -> Core:
        p = dict(self.p)
        for term in terms:
            if "R" in p:
                p["R"] = p["R"] * term.factor_R
            if "K" in p:
                p["K"] = p["K"] * term.factor_K
            p["B"] = p["B"] * term.factor_B
        for term in terms:
            p["B"] = p["B"] + term.viscous
        moment = sum((ca.SX(term.moment_K) for term in terms), start=ca.SX(0))
        turning = None if moment.is_zero() else Turning(self.p["K"], moment)
        return linear_core(self.drive, x, p, h, turning)

    def _solved(self, core: Core, held: _Held, speed: ca.SX | None, *, dry: bool = True) -> _Solved:
        """The core under what acts; blocked current and dry friction such that they stop and never drive.

        Args:
            speed: at the beginning, for a reversal within the step; None: friction is that at its end.
        """
        n, terms = self.core_states, held.terms
        x = core.free + core.per_input * (held.u - self._drop(terms)) + core.per_load * _load(terms)
        x = x + core.per_slope * held.rise
        forward, backward = dry_levels(terms)
        rubs = dry and not (forward.is_zero() and backward.is_zero())
        blocks = self._dry_drop(terms) if dry else ca.SX(0)
        drop, friction = ca.SX(0), ca.SX(0)
        if blocks.is_zero():
            if rubs:
                friction = friction_over_step(speed, x[n - 2], core.per_load[n - 2], forward, backward)
            return _Solved(x + core.per_load * friction, drop, friction)
        for _ in range(_PASSES):
            stopping = (x[0] + core.per_load[0] * friction) / core.per_input[0]
            drop = ca.fmax(ca.fmin(stopping, blocks), -blocks)
            if rubs:
                free = x[n - 2] - core.per_input[n - 2] * drop
                friction = friction_over_step(speed, free, core.per_load[n - 2], forward, backward)
        return _Solved(x - core.per_input * drop + core.per_load * friction, drop, friction)

    def _drop(self, terms: Sequence[Terms]) -> ca.SX:
        """Without a voltage there is nothing that a drop could be taken from."""
        return sum((ca.SX(term.voltage_drop) for term in terms if self.drive == "voltage"), start=ca.SX(0))

    def _dry_drop(self, terms: Sequence[Terms]) -> ca.SX:
        return sum((ca.SX(term.dry_drop) for term in terms if self.drive == "voltage"), start=ca.SX(0))

    def _probe(self) -> tuple[ca.SX, list[Terms]]:
        x = ca.SX.sym("x", len(self.states))
        return x[: self.core_states], self.terms(x, ca.SX(0), ca.SX(0), ca.SX.sym("h"))

    def _mean_square(self, x: ca.SX, held: _Held, solved: _Solved, h: ca.SX) -> ca.SX:
        """⟨i²⟩ over a step, A²."""
        R, K = self.p["R"], self.p["K"]
        for term in held.terms:
            R, K = R * term.factor_R, K * term.factor_K
        n, before = self.core_states, x[0]
        change, turned = solved.x[0] - before, solved.x[n - 1] - x[n - 1]
        u = held.u - self._drop(held.terms) - solved.drop
        mean = (u - (K * turned + self.p["L"] * change) / h) / R
        return flow.mean_square(before, change, mean, -R / self.p["L"] * h)

    def _own_states(self, x: ca.SX, u: ca.SX, t: ca.SX, h: ca.SX, i_square: ca.SX | None = None) -> ca.SX:
        """The effects' states after h, from those in x, with the motion in x taken as constant over h.

        Args:
            i_square: mean of the squared current; None: that of the current in x.
        """
        # Symbols of their own, so that the slope is the partial one: a midpoint current depends on these states too.
        at = ca.SX.sym("at", x.numel())
        rates = {name: rate for term in self.terms(at, u, t, h, i_square) for name, rate in term.rates.items()}
        updates = []
        for k, state in enumerate(self.states[self.core_states :], start=self.core_states):
            if state.name not in rates:
                updates.append(at[k])
                continue
            _, phi1, _ = flow.phi_scalar(ca.jacobian(rates[state.name], at[k]) * h)
            updates.append(at[k] + h * phi1 * rates[state.name])
        return ca.substitute(ca.vertcat(*updates), at, x) if updates else ca.SX(0, 1)

    def _keep_step(self, x: ca.SX, after: ca.SX, gain: ca.SX, delay: Delay, h: ca.SX) -> tuple[ca.SX, ca.SX]:
        """States after the step with what a late channel did in it, and what input and load do to all of them."""
        n, places = self.core_states, self._places(LATE)
        after, gain = ca.SX(after), ca.SX(gain)
        moved = ca.horzcat(after[:n] - x[:n], gain[:n, :])
        current = moved[0, :] if self.drive == "voltage" else ca.SX.zeros(1, 3)
        speed, angle = moved[n - 2, :], moved[n - 1, :]
        change, other = of_channel(delay, current, angle, speed), of_channel(delay, speed, speed, current)
        after[places] = with_newest(x[places], Step(change[0], other[0], h))
        gain[places[0], :], gain[places[LATE_STEPS], :] = change[1:], other[1:]
        return after, gain

    def sensed(self, x: ca.SX, t: ca.SX) -> ca.SX:
        """(current_A, velocity_rad_s, position_rad) as the sensors show them."""
        n, none = self.core_states, ca.SX(0)
        delay = delay_of(self.terms(x, none, t, none))
        if delay is not None:
            late = behind(kept(x[self._places(LATE)]), delay.seconds, x[n - 2], homogeneous(self.drive, self.p))
            only = [
                of_channel(delay, *(value if k == which else none for k, value in enumerate(late)))
                for which in range(3)
            ]
            x = ca.vertcat(x[:n] + ca.vertcat(only[0], only[2], only[1])[3 - n :], x[n:])
        shown = {
            "current_A": x[0] if self.drive == "voltage" else ca.SX(0),
            "velocity_rad_s": x[n - 2],
            "position_rad": x[n - 1],
        }
        for term in self.terms(x, none, t, none):
            for name, error in term.sensed.items():
                if name in shown:
                    shown[name] = shown[name] + error
        return ca.vertcat(*shown.values())


def _load(terms: Sequence[Terms]) -> ca.SX:
    return sum((ca.SX(term.load_torque) for term in terms), start=ca.SX(0))
