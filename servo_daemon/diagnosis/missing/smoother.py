"""The plant with unknown inputs as compiled passes: filter forwards, smoother backwards, and their linear response.

The state is z = (x, d): the plant's states and the unmodelled torque and voltage, which walk at random. One torque or
voltage holds from a sample to the next, as the input does. It acts inside the plant's own step (the torque as its
parameter TL, the voltage as a change of the input), so that a sticking shaft shows what it does to it: nothing.

    z⁺ = (f(x, u − d_V, T_L + d_T), d) + noise           P⁺ = F P Fᵀ + Q

Backwards by Bryson and Frazier's modified form (Bierman, *Factorization Methods for Discrete Sequential Estimation*,
1977, ch. X), which inverts nothing: with F, gain k, innovation ν and its variance s of the forward pass

    λ ← Fᵀ λ,  Λ ← Fᵀ Λ F,   then, channel by channel,   λ ← (I − k H)ᵀ λ − Hᵀ ν/s,   Λ ← (I − k H)ᵀ Λ (I − k H) + HᵀH/s
    z_s = z − P λ,   P_s = P − P Λ P
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import casadi as ca
import numpy as np

from servo_daemon.identification.output_error.problem.rollout import STEP
from servo_daemon.kalman.expressions import natural, pack, unpack
from servo_daemon.kalman.layout import MEASURABLE
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.plant.effects.base import LATE
from servo_daemon.samples import F64

#: Regressors that one call of the linear response carries (chosen; not tried).
BATCH = 8
#: More states than this are those of a delay line, most of which only move on (a delay line has three a step, the
#: other effects two; chosen; not tried).
_FEW_STATES = 10


@dataclass(frozen=True)
class Augmented:
    """A plant with unknown inputs; n_z = n_x + n_d.

    Attributes:
        plant: with the parameter TL.
        channels: measured, c of them.
        disturbances: "torque", "voltage" or both, in that order.
    """

    plant: PlantModel
    channels: tuple[str, ...]
    disturbances: tuple[str, ...]

    @property
    def n_x(self) -> int:
        return len(self.plant.states)

    @property
    def n_z(self) -> int:
        return self.n_x + len(self.disturbances)

    @property
    def n_tri(self) -> int:
        return self.n_z * (self.n_z + 1) // 2

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Where a row of the forward pass has what: state and covariance predicted, the step's derivatives by z and by
        both inputs (torque, voltage), then per channel innovation, 1/s (0: no measurement), gain and H."""
        n, c = self.n_z, len(self.channels)
        sizes = {
            "z": n,
            "P": self.n_tri,
            "F": self.n_x * n,
            "B": self.n_x * 2,
            "innovation": c,
            "precision": c,
            "gain": c * n,
            "H": c * self.n_x,
        }
        ends = np.cumsum(list(sizes.values()))
        return {name: slice(int(end - size), int(end)) for (name, size), end in zip(sizes.items(), ends, strict=True)}


@cache
def _structure(a: Augmented) -> ca.Sparsity:
    """Which elements of the step's derivative by z are not always zero, shape (n_x, n_z)."""
    x, d = ca.SX.sym("x", a.n_x), ca.SX.sym("d", 2)
    moved = _moved(a, x, d[0], d[1], ca.SX.sym("q", len(a.plant.parameters)), ca.SX.sym("row", 3))
    chosen = [("torque", "voltage").index(name) for name in a.disturbances]
    by_state, by_disturbance = ca.jacobian(moved, x).sparsity(), ca.jacobian(moved, d[chosen]).sparsity()
    return ca.horzcat(by_state, by_disturbance)


def _dense(arguments: list[ca.SX], state: ca.SX, output: ca.SX) -> ca.Function:
    """The step for a `SampleLoop`: structural zeros must be written as well."""
    return ca.Function("step", arguments, ca.cse([ca.densify(state), ca.densify(output)]))


def _moved(a: Augmented, x: ca.SX, torque: ca.SX, voltage: ca.SX, q: ca.SX, row: ca.SX) -> ca.SX:
    """x after the step that begins with this sample, under unmodelled torque and voltage."""
    p = natural(a.plant, q)
    p[a.plant.parameter_names.index("TL")] += torque
    return a.plant.step(x, row[2] - voltage, p, row[0], row[1])


def _without(M: ca.SX, gain: ca.SX, H: ca.SX) -> ca.SX:
    """(I − gain H) M, for a column and a row; in n² steps where a delay line brings two dozen states. (With few,
    1 − k h first: it keeps one more digit of what a wide prior leaves.)"""
    n = M.shape[0]
    return (ca.SX.eye(n) - gain @ H) @ M if n <= _FEW_STATES else M - gain @ (H @ M)


@dataclass(frozen=True)
class _Pass:
    """Symbols of the forward pass. Constants: q | walk per disturbance (unit²/s) | variance of the input | r per
    channel. Sample: t | h | input | y per channel | valid per channel."""

    a: Augmented
    state: ca.SX
    const: ca.SX
    row: ca.SX

    @classmethod
    def of(cls, a: Augmented) -> _Pass:
        c = len(a.channels)
        constants = len(a.plant.parameters) + len(a.disturbances) + 1 + c
        return cls(a, ca.SX.sym("state", a.n_z + a.n_tri), ca.SX.sym("const", constants), ca.SX.sym("row", 3 + 2 * c))

    def function(self, output: Callable[[dict[str, ca.SX]], ca.SX]) -> ca.Function:
        a, n_q = self.a, len(self.a.plant.parameters)
        q, walk = self.const[:n_q], self.const[n_q : n_q + len(a.disturbances)]
        z, P = self.state[: a.n_z], unpack(self.state[a.n_z :], a.n_z)
        found: dict[str, ca.SX] = {"z": z, "P": pack(P)}
        z, P, found["innovation"], found["precision"], found["gain"], found["H"] = self._measured(z, P, q)
        z, P, found["F"], found["B"] = self._predicted(z, P, q, walk)
        return _dense([self.state, self.const, self.row], ca.vertcat(z, pack(P)), output(found))

    def _measured(self, z: ca.SX, P: ca.SX, q: ca.SX) -> tuple[ca.SX, ...]:
        a, c = self.a, len(self.a.channels)
        innovations: list[ca.SX] = []
        precisions: list[ca.SX] = []
        gains: list[ca.SX] = []
        rows: list[ca.SX] = []
        for k, channel in enumerate(a.channels):
            x = ca.SX.sym("x", a.n_x)
            shown = a.plant.sensed(x, natural(a.plant, q), self.row[0])[MEASURABLE.index(channel)]
            slope = ca.jacobian(shown, x)
            here, H_x = ca.substitute([shown, slope], [x], [z[: a.n_x]])
            H = ca.horzcat(H_x, ca.SX.zeros(1, a.n_z - a.n_x))
            valid, r = self.row[3 + c + k], self.const[-c + k]
            PH = P @ H.T
            precision = valid / (H @ PH + r)
            innovation = ca.if_else(valid > 0, self.row[3 + k] - here, 0.0)
            gain = PH * precision
            z, P = z + gain * innovation, _without(_without(P, gain, H).T, gain, H) + r * (gain @ gain.T)
            P = (P + P.T) / 2  # Joseph's form: stays positive definite
            innovations, precisions = [*innovations, innovation], [*precisions, precision]
            gains, rows = [*gains, gain], [*rows, H_x.T]
        return z, P, *(ca.vertcat(*part) for part in (innovations, precisions, gains, rows))

    def _predicted(self, z: ca.SX, P: ca.SX, q: ca.SX, walk: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        a, n_x = self.a, self.a.n_x
        x, d = ca.SX.sym("x", n_x), ca.SX.sym("d", 2)
        x_next = _moved(a, x, d[0], d[1], q, self.row)
        chosen = [("torque", "voltage").index(name) for name in a.disturbances]
        at = [z[:n_x], ca.vertcat(*[z[n_x + chosen.index(k)] if k in chosen else 0.0 for k in range(2)])]
        x_new, F_x, B = ca.substitute([x_next, ca.jacobian(x_next, x), ca.jacobian(x_next, d)], [x, d], at)
        F = ca.vertcat(ca.horzcat(F_x, B[:, chosen]), ca.horzcat(ca.SX.zeros(len(chosen), n_x), ca.SX.eye(len(chosen))))
        noise = ca.SX.zeros(a.n_z, a.n_z)
        # A change of the input does what an unmodelled voltage does, but for the sign; without a voltage the input
        # itself.
        noise[:n_x, :n_x] = B[:, 1] @ B[:, 1].T * self.const[len(a.plant.parameters) + len(chosen)]
        for k, state in enumerate(a.plant.states):  # effects' own equations are approximations
            if state.name not in MEASURABLE:
                noise[k, k] += (0.01 * state.scale) ** 2 * self.row[1]
        for k in range(len(chosen)):
            noise[n_x + k, n_x + k] = walk[k] * self.row[1]
        P = F @ P @ F.T + noise
        return ca.vertcat(x_new, z[n_x:]), (P + P.T) / 2, ca.vec(F[:n_x, :]), ca.vec(B)


@cache
def forward(a: Augmented) -> SampleLoop:
    """State z | triangle of P, predicted for the sample; output: the row that `Augmented.columns` describes."""
    return SampleLoop(
        _Pass.of(a).function(lambda found: ca.vertcat(*[found[name] for name in a.columns])),
        paced_by=STEP,
        side_by_side=True,
    )


def _part(a: Augmented, row: ca.SX, name: str) -> ca.SX:
    where = a.columns[name]
    return row[where.start : where.stop]


def _transition(a: Augmented, row: ca.SX) -> ca.SX:
    """F of a row of the forward pass, without what is always zero (of a delay line nearly all)."""
    n_d = len(a.disturbances)
    top = ca.project(ca.reshape(_part(a, row, "F"), a.n_x, a.n_z), _structure(a))
    return ca.vertcat(top, ca.horzcat(ca.SX.zeros(n_d, a.n_x), ca.SX.eye(n_d)))


def _channel(a: Augmented, row: ca.SX, k: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Gain, row H and precision of one measured channel."""
    gain = _part(a, row, "gain")[k * a.n_z : (k + 1) * a.n_z]
    H = ca.vertcat(_part(a, row, "H")[k * a.n_x : (k + 1) * a.n_x], ca.SX.zeros(a.n_z - a.n_x))
    return gain, H, _part(a, row, "precision")[k]


@cache
def backward(a: Augmented) -> SampleLoop:
    """Over the forward pass's rows in reverse; state λ | triangle of Λ; output: smoothed z | its variances (0 for the
    steps of a delay line, which nobody asks for)."""
    n = a.n_z
    state, const = ca.SX.sym("state", n + a.n_tri), ca.SX.sym("const", 1)
    row = ca.SX.sym("row", a.columns["H"].stop)
    lam, Lam = state[:n], unpack(state[n:], n)
    F = _transition(a, row)
    lam, Lam = F.T @ lam, F.T @ Lam @ F
    for k in reversed(range(len(a.channels))):
        gain, H, precision = _channel(a, row, k)
        lam = _without(lam, H, gain.T) - H * (_part(a, row, "innovation")[k] * precision)
        Lam = _without(_without(Lam, H, gain.T).T, H, gain.T) + H @ H.T * precision
    Lam = (Lam + Lam.T) / 2
    P = unpack(_part(a, row, "P"), n)
    late = {state.name for state in LATE}
    asked = [k for k, state in enumerate(a.plant.states) if state.name not in late] + list(range(a.n_x, n))
    variance = ca.SX.zeros(n)
    for k in asked:
        variance[k] = P[k, k] - P[k, :] @ Lam @ P[:, k]
    smoothed = ca.vertcat(_part(a, row, "z") - P @ lam, variance)
    return SampleLoop(_dense([state, const, row], ca.vertcat(lam, pack(Lam)), smoothed))


@cache
def response_forward(a: Augmented) -> SampleLoop:
    """How true state, prediction and innovations move with disturbances (torque, voltage) and sensor errors; `BATCH`
    cases at once. Sample: forward row | per case torque, voltage, error per channel. Output: per case z,
    innovations."""
    n_x, n, c = a.n_x, a.n_z, len(a.channels)
    state, const = ca.SX.sym("state", BATCH * (n_x + n)), ca.SX.sym("const", 1)
    width = a.columns["H"].stop
    row = ca.SX.sym("row", width + BATCH * (2 + c))
    F, B = _transition(a, row), ca.reshape(_part(a, row, "B"), n_x, 2)
    after, outputs = [], []
    for case in range(BATCH):
        own = state[case * (n_x + n) : (case + 1) * (n_x + n)]
        x, z = own[:n_x], own[n_x:]
        given = row[width + case * (2 + c) : width + (case + 1) * (2 + c)]
        innovations: list[ca.SX] = []
        predicted = z
        for k in range(c):
            gain, H, precision = _channel(a, row, k)
            seen = ca.if_else(precision > 0, H[:n_x].T @ (x - z[:n_x]) + given[2 + k], 0.0)
            innovations, z = [*innovations, seen], z + gain * seen
        after += [F[:n_x, :n_x] @ x + B @ given[:2], F @ z]
        outputs += [predicted, *innovations]
    return SampleLoop(_dense([state, const, row], ca.vertcat(*after), ca.vertcat(*outputs)))


@cache
def response_backward(a: Augmented) -> SampleLoop:
    """The smoother's mean over `response_forward`. Sample: forward row | its output. Output: per case d."""
    n, c = a.n_z, len(a.channels)
    state, const, width = ca.SX.sym("state", BATCH * n), ca.SX.sym("const", 1), a.columns["H"].stop
    row = ca.SX.sym("row", width + BATCH * (n + c))
    F, P = _transition(a, row), unpack(_part(a, row, "P"), n)
    after, outputs = [], []
    for case in range(BATCH):
        lam = F.T @ state[case * n : (case + 1) * n]
        given = row[width + case * (n + c) : width + (case + 1) * (n + c)]
        for k in reversed(range(c)):
            gain, H, precision = _channel(a, row, k)
            lam = lam - H * (gain.T @ lam + given[n + k] * precision)
        after.append(lam)
        outputs.append((given[:n] - P @ lam)[a.n_x :])
    return SampleLoop(_dense([state, const, row], ca.vertcat(*after), ca.vertcat(*outputs)))


def packed(P: F64) -> F64:
    """Lower triangle, column by column, of a NumPy matrix."""
    n = len(P)
    return np.array([P[row, column] for column in range(n) for row in range(column, n)])
