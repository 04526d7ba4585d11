"""The plant run freely over a recording, with the exact derivatives of what the sensors show.

Forward sensitivities of the discrete step x⁺ = f(x, u, q, t, h), carried along with it:

    X⁺ = F X,  X(0) = I          ∂x/∂x₀               F = ∂f/∂x
    Q⁺ = F Q + G,  Q(0) = 0      ∂x/∂q                G = ∂f/∂q

They are the derivatives of the very numbers the simulation gives, not of a differential equation near it, so a
Gauss–Newton method meets no noise of an integrator's step control. One pass costs about as much as two of the EKF.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from servo_daemon.kalman.expressions import natural
from servo_daemon.kalman.layout import MEASURABLE
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

#: Samples of a long run that go through a call: what they show stays in the processor's cache (chosen; the derivatives
#: of a winding that heats for 60 s at 1 kHz take 123 ms so, 184 ms with all samples at once).
_AT_ONCE = 1024
#: Columns of a sample: s since the recording began, s to the next sample, the input until then.
TIME, STEP, INPUT = range(3)


@dataclass(frozen=True, slots=True)
class Simulated:
    """A free run.

    Attributes:
        shown: shape (n, c), what the sensors of the measured channels show.
        by_state: shape (n, c, nx), derivative by the initial state.
        by_parameter: shape (n, c, np), derivative by the parameters' coordinates (logarithms where positive).
        last: shape (nx,), the state after the last step.
    """

    shown: F64
    by_state: F64
    by_parameter: F64
    last: F64


@cache
def _sensitivity_step(plant: PlantModel, channels: tuple[str, ...]) -> ca.Function:
    n, n_q = len(plant.states), len(plant.parameters)
    state, q, row = ca.SX.sym("state", n * (1 + n + n_q)), ca.SX.sym("q", n_q), ca.SX.sym("row", 3)
    x, S = state[:n], ca.reshape(state[n:], n, n + n_q)
    x_next = plant.step(x, row[INPUT], natural(plant, q), row[TIME], row[STEP])
    shown = _shown(plant, channels, x, q, row[TIME])
    F, G = ca.jacobian(x_next, x), ca.jacobian(x_next, q)
    S_next = F @ S + ca.horzcat(ca.SX.zeros(n, n), G)
    slopes = ca.jacobian(shown, x) @ S + ca.horzcat(ca.SX.zeros(len(channels), n), ca.jacobian(shown, q))
    outputs = ca.vertcat(shown, ca.vec(slopes.T))
    return ca.Function("step", [state, q, row], ca.cse([ca.vertcat(x_next, ca.vec(S_next)), outputs]))


@cache
def _plain_step(plant: PlantModel, channels: tuple[str, ...]) -> ca.Function:
    n, n_q = len(plant.states), len(plant.parameters)
    x, q, row = ca.SX.sym("x", n), ca.SX.sym("q", n_q), ca.SX.sym("row", 3)
    x_next = plant.step(x, row[INPUT], natural(plant, q), row[TIME], row[STEP])
    outputs = ca.vertcat(_shown(plant, channels, x, q, row[TIME]), x)
    return ca.Function("step", [x, q, row], ca.cse([x_next, outputs]))


def _shown(plant: PlantModel, channels: Sequence[str], x: ca.SX, q: ca.SX, t: ca.SX) -> ca.SX:
    sensed = plant.sensed(x, natural(plant, q), t)
    return ca.vertcat(*[sensed[MEASURABLE.index(c)] for c in channels])


@cache
def _loop(plant: PlantModel, channels: tuple[str, ...], sensitivities: bool) -> SampleLoop:
    """Compiled once in a process: a fit calls it many times."""
    step = (_sensitivity_step if sensitivities else _plain_step)(plant, channels)
    return SampleLoop(step, paced_by=STEP, side_by_side=True)


def _through(plant: PlantModel, loop: SampleLoop, states: F64, q: F64, rows: F64, current: Sequence[int]) -> F64:
    """`loop.run_many` over the samples in the plant's pieces; what is shown at the samples themselves.

    Args:
        current: columns of the current and of its derivatives.
    """
    if plant.pieces == 1:
        return loop.run_many(states, q, rows)
    blocks = [rows[:, a : a + _AT_ONCE] for a in range(0, rows.shape[1], _AT_ONCE)]
    out, means, averaged = [], [], plant.mean_current and len(current) > 0
    for block in blocks:
        run = loop.run_many(states, q, _in_pieces(block, plant.pieces))
        out.append(run[:, :: plant.pieces])
        if averaged:
            pieces = run[:, :, current].reshape(len(run), -1, plant.pieces, len(current))
            means.append(np.einsum("p,knpc->knc", _simpson(plant.pieces)[:-1], pieces))
    shown = np.concatenate(out, axis=1)
    if averaged:  # the first sample's began before the run, which shows its value there
        last = _simpson(plant.pieces)[-1] * shown[:, 1:, current]
        shown[:, 1:, current] = np.concatenate(means, axis=1)[:, :-1] + last
    return shown


@cache
def _simpson(pieces: int) -> F64:
    """Weights of the mean of an interval in so many pieces, shape (pieces + 1,)."""
    weights = np.full(pieces + 1, 2.0)
    weights[1::2], weights[[0, -1]] = 4.0, 1.0
    return weights / (3.0 * pieces)


def _of_current(channels: tuple[str, ...], slopes: int = 0) -> list[int]:
    """Columns of the current and of its derivatives in what a run shows.

    Args:
        slopes: derivatives of each channel, behind all channels.
    """
    if "current_A" not in channels:
        return []
    at, c = channels.index("current_A"), len(channels)
    return [at, *range(c + at * slopes, c + (at + 1) * slopes)]


def _in_pieces(rows: F64, pieces: int) -> F64:
    """Each row, shape (k, n, 3), as so many with the same input."""
    cut = np.repeat(rows, pieces, axis=1)
    cut[..., STEP] /= pieces
    cut[..., TIME] += np.tile(np.arange(pieces), rows.shape[1]) * cut[..., STEP]
    return cut


def simulate(plant: PlantModel, channels: tuple[str, ...], q: F64, x0: F64, rows: F64) -> Simulated:
    """Free run with sensitivities.

    Args:
        channels: which of current_A, velocity_rad_s, position_rad are shown.
        q: shape (np,), the parameters' coordinates in the plant's order.
        x0: shape (nx,), the state at the first sample.
        rows: shape (n, 3), C-contiguous: `TIME`, `STEP`, `INPUT`.
    """
    one = simulate_many(plant, channels, q, x0[None], rows[None])
    return Simulated(one.shown[0], one.by_state[0], one.by_parameter[0], one.last[0])


def simulate_many(plant: PlantModel, channels: tuple[str, ...], q: F64, x0: F64, rows: F64) -> Simulated:
    """The same of many runs at once: everything has a first axis more, of length k.

    Args:
        x0: shape (k, nx).
        rows: shape (k, n, 3), C-contiguous.
    """
    n, n_q, c = len(plant.states), len(plant.parameters), len(channels)
    states = np.zeros((len(rows), n * (1 + n + n_q)))
    states[:, :n] = x0
    states[:, n : n + n * n] = np.eye(n).ravel()
    out = _through(plant, _loop(plant, channels, True), states, q, rows, _of_current(channels, n + n_q))
    slopes = out[:, :, c:].reshape(*rows.shape[:2], c, n + n_q)
    return Simulated(out[:, :, :c], slopes[..., :n], slopes[..., n:], states[:, :n].copy())


def free_run(plant: PlantModel, channels: tuple[str, ...], q: F64, x0: F64, rows: F64) -> tuple[F64, F64]:
    """Free run without sensitivities: what is shown, shape (n, c), and the plant's states, shape (n, nx)."""
    states = np.array(x0, dtype=np.float64)[None]
    out = _through(
        plant, _loop(plant, channels, False), states, q, np.ascontiguousarray(rows)[None], _of_current(channels)
    )[0]
    return out[:, : len(channels)], out[:, len(channels) :]


def free_runs(plant: PlantModel, channels: tuple[str, ...], q: F64, x0: F64, rows: F64) -> F64:
    """Many free runs: what is shown, shape (k, n, c).

    Args:
        q: shape (np,), or (k, np): each run's own.
        x0: shape (k, nx).
        rows: shape (k, n, 3), C-contiguous.
    """
    states = np.array(x0, dtype=np.float64, order="C")
    out = _through(plant, _loop(plant, channels, False), states, q, rows, _of_current(channels))
    return out[:, :, : len(channels)]


def free_states(plant: PlantModel, channels: tuple[str, ...], q: F64, x0: F64, rows: F64, at: NDArray[np.intp]) -> F64:
    """The plant's states at some samples of long free runs over the same input, shape (k, m, nx).

    Args:
        q: shape (k, np), each run's own.
        x0: shape (nx,), where all begin.
        rows: shape (n, 3).
        at: shape (m,), numbers of the samples.
    """
    loop, k, out = _loop(plant, channels, False), len(q), np.empty((len(q), len(at), len(x0)))
    states = np.tile(x0, (k, 1))
    for begin in range(0, int(np.max(at, initial=-1)) + 1, _AT_ONCE):
        part = rows[begin : begin + _AT_ONCE]
        shown = _through(plant, loop, states, q, np.tile(part, (k, 1, 1)), ())
        here = np.flatnonzero((at >= begin) & (at < begin + len(part)))
        out[:, here] = shown[:, at[here] - begin, len(channels) :]
    return out
