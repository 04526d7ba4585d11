"""What an effect adds to the motor's balances, read off its terms, and along a recorded motion.

    v = R i + L di/dt + K ω + voltage        K i = J dω/dt + B ω + torque        shown = true + error

Whoever asks how an effect shows (screening, the regressions, the choice of signals) needs nothing of it but its terms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import casadi as ca
import numpy as np

from servo_daemon.parameters import LINEAR, Parameter
from servo_daemon.plant import flow
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.plant.core import Drive
from servo_daemon.plant.effects import Effect, Signals, Terms, effects_by_name
from servo_daemon.plant.effects.base import probe
from servo_daemon.samples import F64

#: What a motion is given as, in this order; see `Contribution.along`.
MOTION = ("t", "v", "i", "i_square", "omega", "theta", "torque", "h", "sliding", "flowing")
#: The balances and the sensors.
BALANCES = ("torque", "voltage")
SENSORS = ("current_A", "position_rad", "velocity_rad_s")
#: What is left when the parameters are 0 is rounding below this share.
_NOTHING = 1e-9


@dataclass(frozen=True, eq=False)
class Contribution:
    """What one effect adds.

    Attributes:
        effect: which.
        signals: the symbols that the expressions are of.
        terms: as it declares them.
        direction: symbols of the share of dry friction that acts, −1 .. 1 (the direction of motion, where it moves),
            and of the current's direction.
    """

    effect: Effect
    signals: Signals
    terms: Terms
    direction: tuple[ca.SX, ca.SX]

    @cached_property
    def adds(self) -> Mapping[str, ca.SX]:
        """To each balance, N·m and V, and to what each sensor shows."""
        s, t, (sliding, flowing) = self.signals, self.terms, self.direction
        forward, backward = t.dry_levels
        torque = (
            t.load_torque
            + (t.viscous + (t.factor_B - 1) * s.p["B"]) * s.omega
            - (t.factor_K - 1) * s.p["K"] * s.i
            + forward * ca.fmax(sliding, 0)
            + backward * ca.fmin(sliding, 0)
            + (t.factor_dry - 1) * s.p["Tc"] * sliding
        )
        voltage = (
            t.voltage_drop
            + (t.factor_R - 1) * s.p["R"] * s.i
            + (t.factor_K - 1) * s.p["K"] * s.omega
            + t.dry_drop * flowing
        )
        shown = {name: ca.SX(t.sensed.get(name, 0.0)) for name in SENSORS}
        return {name: ca.simplify(x) for name, x in {"torque": torque, "voltage": voltage, **shown}.items()}

    @property
    def is_along_motion(self) -> bool:
        """Whether it only adds to balances and sensors: no second inertia, lag or delay."""
        t = self.terms
        return t.shaft is None and t.lag_s is None and t.delay is None and any(map(self.touches, self.adds))

    def touches(self, name: str) -> bool:
        """Whether it adds anything to a balance or a sensor."""
        return not self.adds[name].is_zero()

    def shows(self, drive: Drive) -> bool:
        """Whether anything measured shows it where the input is a voltage, current or torque: the winding's
        balance is not used without a voltage, nor the torque constant where the torque is the input."""
        t, moving = self.terms, SENSORS[1:]
        if drive == "voltage" or t.shaft is not None or t.delay is not None or any(map(self.touches, moving)):
            return True
        if drive == "current":
            return self.touches("torque")
        K, i = self.signals.p["K"], self.signals.i
        return t.lag_s is not None or not ca.substitute(self.adds["torque"], ca.vertcat(K, i), ca.DM.zeros(2)).is_zero()

    def follows(self, *symbols: ca.SX) -> bool:
        """Whether anything that it adds depends on one of these."""
        return bool(ca.depends_on(self._all, ca.vertcat(*symbols)))

    @cached_property
    def _all(self) -> ca.SX:
        return ca.vertcat(*self.adds.values(), *self.terms.rates.values())

    @cached_property
    def linear(self) -> tuple[Parameter, ...]:
        """Parameters that all it adds is linear in, and vanishes with."""
        found: list[Parameter] = []
        for p in self.effect.parameters:
            symbols = [self.signals.p[q.name] for q in (*found, p)]
            at = ca.vertcat(*symbols)
            if self.follows(symbols[-1]) and not ca.depends_on(ca.jacobian(self._all, at), at):
                found.append(p)
        return tuple(found) if self._vanishes_with(found) else ()

    def _vanishes_with(self, parameters: Sequence[Parameter]) -> bool:
        """At motions and values drawn at random, states and their rates included."""
        names = [p.name for p in parameters]
        motion, states, p = self._inputs
        at = ca.Function("at", [motion, states, p], [self._all])
        rng = np.random.default_rng(0)
        for _ in range(3):
            row, held = rng.uniform(0.1, 1.0, motion.numel()), rng.uniform(0.1, 1.0, states.numel())
            values = rng.uniform(0.1, 1.0, p.numel())
            nothing = np.where([n in names for n in self.names], 0.0, values)
            with_it, without = (np.asarray(at(row, held, q)).ravel() for q in (values, nothing))
            if not (np.abs(without) <= _NOTHING * np.abs(with_it).max()).all():
                return False
        return True

    def is_offset(self, balance: str) -> bool:
        """Whether some part of what it adds to a balance is a constant of any size, whatever the motion."""
        motion, states, _ = self._inputs
        slopes = (ca.gradient(self.adds[balance], self.signals.p[p.name]) for p in self.linear)
        return any(not g.is_zero() and not ca.depends_on(g, ca.vertcat(motion, states)) for g in slopes)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that the expressions may depend on: the motor's, Tc, its own."""
        return tuple(self.signals.p)

    @property
    def _inputs(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        s, (sliding, flowing) = self.signals, self.direction
        motion = ca.vertcat(s.t, s.v, s.i, s.i_square, s.omega, s.theta, s.torque, s.h, sliding, flowing)
        return motion, ca.vertcat(ca.SX(0, 1), *s.states.values()), ca.vertcat(*s.p.values())

    @cached_property
    def _loop(self) -> SampleLoop:
        """Output: all that it adds, then its derivatives by the linear parameters. The effect's states go by an
        exponential step each, as in `step.py`; an effect without states gets one that stays 0."""
        motion, states, p = self._inputs
        after = [
            state + self.signals.h * rate * flow.phi_scalar(ca.gradient(rate, state) * self.signals.h)[1]
            for name, state in self.signals.states.items()
            for rate in [ca.SX(self.terms.rates.get(name, 0.0))]
        ]
        adds = ca.vertcat(*self.adds.values())
        own = ca.vertcat(ca.SX(0, 1), *(self.signals.p[q.name] for q in self.linear))
        output = ca.vertcat(adds, ca.vec(ca.jacobian(adds, own)))
        begin = states if after else ca.SX.sym("none")
        return SampleLoop(ca.Function("step", [begin, p, motion], [ca.vertcat(*after) if after else begin, output]))

    def along(self, motion: Mapping[str, F64], values: Mapping[str, float]) -> dict[str, F64]:
        """What it adds along a motion.

        Args:
            motion: by the names of `MOTION`, SI units, shapes (n,) or numbers; what is left out is 0, `i_square` the
                current's square. `sliding` and `flowing`: the directions of motion and current.
            values: parameters, natural units; those left out are at their nominal value.

        Returns:
            By balance and sensor, shape (n, 1 + m): all, then per unit of each of the m `linear` parameters.
        """
        table = {q.name: q.nominal for q in (*LINEAR, *self.effect.parameters)}
        n = max(np.size(x) for x in motion.values())
        given = {"i_square": np.square(motion.get("i", np.zeros(1))), **motion}
        rows = np.column_stack([np.broadcast_to(given.get(name, 0.0), (n,)) for name in MOTION]).astype(np.float64)
        states = [state.initial for state in self.effect.states] or [0.0]
        constants = np.array([values.get(name, table.get(name, 0.0)) for name in self.names], dtype=np.float64)
        out = self._loop.run(np.array(states), constants, np.ascontiguousarray(rows))
        adds = list(self.adds)
        return {name: out[:, k :: len(adds)] for k, name in enumerate(adds)}


@cache
def contribution(name: str) -> Contribution:
    """What an effect of the library adds, by the effect's name."""
    effect = effects_by_name()[name]
    return Contribution(effect, *probe(effect), (ca.SX.sym("sliding"), ca.SX.sym("flowing")))
