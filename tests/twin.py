"""The NumPy twin: the same step as `plant/step.py`, from other building blocks, to compare with.

The linear core and the spring of a second inertia are SciPy's `expm` instead of the closed form, flanks part where a
root finder says so, the splitting is written out in NumPy, and only the effects' own terms are shared (evaluated on
numbers): an effect's formula exists once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.core import FADES
from servo_daemon.plant.effects import Signals, State, effects_by_name
from servo_daemon.plant.effects.base import LAGGED, LATE, TWIST
from servo_daemon.samples import F64

_FACTORS = ("factor_R", "factor_K", "factor_B", "factor_dry")
_SUMS = ("load_torque", "voltage_drop", "dry_drop", "viscous", "moment_K")


def _driven_step(p: Mapping[str, float], h: float, turning: tuple[float, float]) -> tuple[F64, F64]:
    """One motor's, with a third input: the rise of the voltage about its mean.

    Args:
        turning: a torque constant that changes within the step, and the first moment of its change over it, s.
    """
    R, L, K, J, B = (p[name] for name in ("R", "L", "K", "J", "B"))
    augmented = np.zeros((7, 7))
    augmented[:3, :3] = np.array([[-R / L, -K / L, 0.0], [K / J, -B / J, 0.0], [0.0, 1.0, 0.0]])
    augmented[0, 3], augmented[1, 4], augmented[0, 5], augmented[5, 6] = 1 / L, -1 / J, 1 / L, 1 / h
    exponent = augmented * h
    if turning[1]:
        change, fades = np.zeros((7, 7)), 1 / (1 + (h * (R / L - B / J)) ** 2 / FADES)
        change[0, 1], change[1, 0] = -turning[0] / L, turning[0] / J
        exponent -= turning[1] * h * fades * (augmented @ change - change @ augmented)
    step = expm(exponent)
    rise = step[:3, 6] - step[:3, 5] / 2
    rise[2] = 0.0  # of third order in h, left out as in `core.py`
    return step[:3, :3], np.column_stack([step[:3, 3:5], rise])


@dataclass(frozen=True)
class _Twin:
    model: PlantModel
    u: float
    p: Mapping[str, float]

    def places(self, states: Sequence[State]) -> list[int]:
        return [self.model.states.index(s) for s in states if s in self.model.states]

    def terms(self, x: F64, t: float, h: float, i_square: float | None = None) -> dict[str, float]:
        """Sums (factors: products) of all effects' terms, and the rates of their states, as numbers."""
        own = dict(zip(self.model.state_names[3:], map(ca.DM, x[3:]), strict=True))
        time, voltage, torque, length = map(ca.DM, (t, self.u, self.p["K"] * x[0], h))
        current, speed, angle = map(ca.DM, x[:3])
        p = {k: ca.DM(v) for k, v in self.p.items()}
        square = current**2 if i_square is None else ca.DM(i_square)
        signals = Signals(time, voltage, current, square, speed, angle, torque, length, states=own, p=p)
        total = dict.fromkeys(_SUMS, 0.0) | dict.fromkeys(_FACTORS, 1.0)
        levels, rates, extra = np.zeros(2), dict[str, float](), dict[str, float]()
        for name in self.model.effects:
            term = effects_by_name()[name].terms(signals)
            total |= {key: total[key] + float(getattr(term, key)) for key in _SUMS}
            total |= {key: total[key] * float(getattr(term, key)) for key in _FACTORS}
            levels += [float(level) for level in term.dry_levels]
            rates |= {state: float(rate) for state, rate in term.rates.items()}
            if term.shaft is not None:
                extra |= {"J_l": float(term.shaft.J_l), "k_s": float(term.shaft.k_s), "c_s": float(term.shaft.c_s)}
                extra["edge"] = 0.0 if term.shaft.gap is None else float(term.shaft.gap) / 2
            extra |= {} if term.lag_s is None else {"lag_s": float(term.lag_s)}
        forward, backward = levels * total["factor_dry"]
        return total | rates | extra | {"dry_forward": forward, "dry_backward": backward}

    def core(self, x: F64, terms: Mapping[str, float], acting: tuple[float, float], h: float) -> tuple[F64, F64]:
        """(i, ω, θ) after h without dry friction and drop, and the change per V, N·m and V of rise, shape (3, 3)."""
        scaled = {**self.p, "R": self.p["R"] * terms["factor_R"], "K": self.p["K"] * terms["factor_K"]}
        scaled["B"] = self.p["B"] * terms["factor_B"] + terms["viscous"]
        Ad, Bd = _driven_step(scaled, h, (self.p["K"], terms["moment_K"]))
        return Ad @ x[:3] + Bd @ [acting[0] - terms["voltage_drop"], terms["load_torque"], acting[1]], Bd

    def mean_square(self, x: F64, after: F64, terms: Mapping[str, float], acting: float, h: float) -> float:
        """⟨i²⟩ over the step, by quadrature over the curve through both ends with the mean that the voltages give.

        Args:
            acting: mean voltage less all drops.
        """
        R, K = self.p["R"] * terms["factor_R"], self.p["K"] * terms["factor_K"]
        mean = (acting - (K * (after[2] - x[2]) + self.p["L"] * (after[0] - x[0])) / h) / R
        z = -R / self.p["L"] * h
        nodes, weights = np.polynomial.legendre.leggauss(60)
        s, w = (nodes + 1) / 2, weights / 2
        third, its_mean = (s * s, 1 / 3) if -z < 0.05 else (np.exp(z * s), np.expm1(z) / z)
        ends = (0.0, 1.0) if -z < 0.05 else (1.0, np.exp(z))
        shape = np.array([[1.0, 0.0, ends[0]], [1.0, 1.0, ends[1]], [1.0, 0.5, its_mean]])
        i = np.column_stack([np.ones_like(s), s, third]) @ np.linalg.solve(shape, [x[0], after[0], mean])
        return float(w @ i**2)

    def own_state(self, k: int, x: F64, t: float, h: float, i_square: float | None = None) -> float:
        """Exponential step of one state of an effect; the slope of its rate by a central difference."""
        name, d = self.model.state_names[k], 1e-4 * (1.0 + abs(x[k]))
        shift = d * np.eye(len(x))[k]
        rate, above, below = (self.terms(at, t, h, i_square).get(name, 0.0) for at in (x, x + shift, x - shift))
        z = (above - below) / (2 * d) * h
        return float(x[k] + h * rate * (np.expm1(z) / z if z else 1.0))

    def lagged(self, x: F64, terms: Mapping[str, float], h: float) -> tuple[float, float, float]:
        """Mean, rise and end of the voltage over the step, by quadrature."""
        place = self.places((LAGGED,))
        if not place:
            return self.u, 0.0, self.u
        behind = float(x[place[0]]) - self.u
        nodes, weights = np.polynomial.legendre.leggauss(60)
        z, w = (nodes + 1) / 2, weights / 2
        v = self.u + behind * np.exp(-z * h / terms["lag_s"])
        end = self.u + behind * np.exp(-h / terms["lag_s"])
        return float(w @ v), float(12 * w @ (v * (z - 0.5))), float(end)

    def substep(self, x: F64, t: float, h: float) -> F64:
        declared = self.terms(x, t, h)
        mean, rise, end = self.lagged(x, declared, h)
        twist = self.places(TWIST)
        begin, angle = x[:3].copy(), x[2] + h / 2 * x[1]
        z = np.zeros(2)
        if twist:
            begin, z = self.half(x[:3], x[twist], declared, h / 2)
            angle = begin[2]
        own_middle = [self.own_state(k, x, t, h / 2) for k in range(3, len(x))]
        ahead = self.terms(np.r_[begin[:2], angle, own_middle], t + h / 2, h)
        guess, gains = self.core(begin, ahead, (mean, rise), h)
        if self.follows():
            guess, _ = self.solved(guess, gains, ahead, None if twist else x[1])
        middle_x = (begin + guess) / 2
        middle_x[2] = angle if twist else middle_x[2]
        middle = self.terms(np.r_[middle_x, own_middle], t + h / 2, h)
        core, gains = self.core(begin, middle, (mean, rise), h)
        if not twist:
            core, drop = self.solved(core, gains, middle, x[1])
        else:
            core[2], gains[2] = begin[2], 0.0
            core, z, drop = self.second_half(core, gains, z + np.array([core[1] - begin[1], 0.0]), middle, h / 2)
        i_square = self.mean_square(x, core, middle, mean - middle["voltage_drop"] - drop, h)
        own = [self.own_state(k, np.r_[middle_x, x[3:]], t + h / 2, h, i_square) for k in range(3, len(x))]
        out = np.concatenate((core, own))
        if twist:
            out[twist] = z
        out[self.places((LAGGED,))] = end
        return out

    def follows(self) -> bool:
        """Whether the guess is made with dry friction: by what the effects here are known to depend on."""
        needing = ("stribeck", "load_dep", "quadratic", "cogging")
        return any(name.startswith(needing) for name in self.model.effects)

    @staticmethod
    def solved(x: F64, gains: F64, terms: Mapping[str, float], speed: float | None = None) -> tuple[F64, float]:
        """Blocked current and dry friction; with the speed at the beginning a reversal is found within the step. And
        the dry drop, V."""
        drop = friction = 0.0
        for _ in range(3):
            stopping = (x[0] + gains[0, 1] * friction) / gains[0, 0]
            drop = np.clip(stopping, -terms["dry_drop"], terms["dry_drop"])
            levels = (-terms["dry_backward"], terms["dry_forward"])
            friction = _friction(speed, x[1] - gains[1, 0] * drop, gains[1, 1], levels)
        return np.asarray(x - gains[:, 0] * drop + gains[:, 1] * friction), float(drop)

    def second_half(
        self, core: F64, gains: F64, z: F64, terms: Mapping[str, float], half: float
    ) -> tuple[F64, F64, float]:
        """The shaft's second half step, friction such that the motor stands at its end. And the dry drop, V."""
        predicted, _ = self.solved(core, gains, terms)
        at = self.meeting(z + np.array([predicted[1] - core[1], 0.0]), terms, half)
        after, z_after = self.half(core, z, terms, half, at)
        moved, moved_z = self.half(core + gains[:, 1], z + np.array([gains[1, 1], 0.0]), terms, half, at)
        driven, driven_z = self.half(core + gains[:, 0], z + np.array([gains[1, 0], 0.0]), terms, half, at)
        per = np.column_stack([np.r_[driven - after, driven_z - z_after], np.r_[moved - after, moved_z - z_after]])
        out, drop = self.solved(np.r_[after, z_after], per, terms)
        return out[:3], out[3:], drop

    def spring(self, z: F64, flank: float, terms: Mapping[str, float], seconds: float) -> F64:
        mu = 1 / (1 / self.p["J"] + 1 / terms["J_l"])
        A = np.array([[-terms["c_s"] / mu, -terms["k_s"] / mu], [1, 0]])
        return np.asarray(expm(A * seconds) @ (z - [0, flank]) + [0, flank])

    def meeting(self, z: F64, terms: Mapping[str, float], half: float) -> tuple[float, float, float, float]:
        """Seconds free, in contact, free again, and the flank."""
        edge = terms["edge"]
        if edge == 0.0:
            return 0.0, half, 0.0, 0.0

        def force(state: F64, side: float) -> float:
            return float(side * (terms["k_s"] * (state[1] - side * edge) + terms["c_s"] * state[0]))

        side = float(np.sign(z[1]))
        before = 0.0
        if abs(z[1]) <= edge or force(z, side) <= 0:
            side = float(np.sign(z[0]))
            before = float(np.clip((edge - side * z[1]) / abs(z[0]), 0, half))
        met, left = z + np.array([0, before * z[0]]), half - before
        times = np.linspace(0.0, left, 2000)[1:] if left > 0 else np.empty(0)
        touching = left
        for a, b in zip([left * 1e-9, *times], times, strict=False):
            if force(self.spring(met, side * edge, terms, b), side) < 0:
                touching = float(
                    brentq(lambda s: force(self.spring(met, side * edge, terms, s), side), a, b, xtol=1e-16)
                )
                break
        parted = self.spring(met, side * edge, terms, touching)
        across = (side * parted[1] + edge) / max(-side * parted[0], 1e-30)
        return before, touching, float(np.clip(across, 0, left - touching)), side * edge

    def half(
        self,
        x: F64,
        z: F64,
        terms: Mapping[str, float],
        half: float,
        at: tuple[float, float, float, float] | None = None,
    ) -> tuple[F64, F64]:
        """(i, ω, θ) and (δ', δ) after the two inertias have moved freely for half a step."""
        before, touching, after, flank = self.meeting(z, terms, half) if at is None else at
        end = self.spring(z + np.array([0, before * z[0]]), flank, terms, touching)
        end = end + np.array([0, after * end[0]])
        share = terms["J_l"] / (self.p["J"] + terms["J_l"])
        common = x[1] - share * z[0]
        return np.array([x[0], common + share * end[0], x[2] + half * common + share * (end[1] - z[1])]), end

    def late(self, x: F64, after: F64, h: float) -> F64:
        """The states of a late sensor after the step: changes, other changes and lengths of the last ones, the newest
        first."""
        channel = round(self.p["channel"])
        moved = after - x
        before = x[self.places(LATE)].reshape(3, -1)
        newest = np.array([moved[[0, 2, 1][channel]], moved[[1, 1, 0][channel]], h])
        return np.column_stack([newest, before[:, :-1]]).ravel()


def reference_step(model: PlantModel, x: F64, u: float, p: F64, t: float, h: float) -> F64:
    """x(t + h) with the voltage u held. Shapes as in `PlantModel.step`; voltage-driven models only."""
    twin = _Twin(model, u, dict(zip(model.parameter_names, map(float, p), strict=True)))
    parts = max((effects_by_name()[name].substeps for name in model.effects), default=1)
    path = [np.asarray(x, dtype=np.float64)]
    for k in range(parts):
        path.append(twin.substep(path[-1], t + k * h / parts, h / parts))
    if "measurement_delay" in model.effects:
        path[-1] = path[-1].copy()
        path[-1][twin.places(LATE)] = twin.late(path[0], path[-1], h)
    return path[-1]


def _friction(speed: float | None, free: float, per_load: float, levels: tuple[float, float]) -> float:
    """Mean of the level until the speed is zero and of what keeps it zero from there on."""
    if speed is None:
        return float(np.clip(-free / per_load, *levels))
    sliding = levels[1] if speed >= 0 else levels[0]
    end = free + per_load * sliding
    share = abs(speed) / (abs(speed) + abs(end)) if speed * end <= 0 and speed else float(speed * end > 0)
    return float(share * sliding + (1 - share) * np.clip((speed - free) / per_load, *levels))
