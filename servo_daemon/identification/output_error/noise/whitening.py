"""Kalman filter of what a free run leaves, linear along the simulated trajectory, over any number of columns at once.

A free run knows nothing of the noise that enters the motor: a voltage or torque that the recording does not show is
integrated and leaves coloured residuals. To first order they obey

    ξ⁺ = F ξ + g_u w_u + g_τ w_τ,   ξ(0) = 0          F = ∂f/∂x at the simulated state, w white, held over a step
    e = H ξ + v                                         v white, one variance for each channel

(ξ(0) = 0: the initial state is an unknown of the fit, its error is a column of the sensitivities). The filter's
innovations over their standard deviations are the residuals times the inverse Cholesky factor of their covariance
(Kailath, Sayed & Hassibi, *Linear Estimation*, 2000, ch. 9; Ljung, *System Identification*, 2nd ed. 1999, ch. 3): white
if the model of the noise is right. The same numbers whiten the sensitivities, column by column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.problem.rollout import INPUT, STEP, TIME
from servo_daemon.kalman.expressions import natural
from servo_daemon.kalman.layout import MEASURABLE
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

#: White inputs: of the model's input and of the load torque.
SOURCES = 2
#: Columns that one compiled pass takes; one alone for the likelihood.
_BATCH = 8
#: More equal samples in a row are a channel that stands.
_LONGEST_REPEAT = 3


@dataclass(frozen=True, slots=True)
class Whitened:
    """Innovations over their standard deviations.

    Attributes:
        values: shape (n, c, k); 0 where a sample is not valid.
        log_variance: shape (n, c), of the innovations; 0 where not valid.
    """

    values: F64
    log_variance: F64


@dataclass(frozen=True, slots=True)
class Structure:
    """Which elements of F, (g_u, g_τ) and H are not always zero: of a late sensor's two dozen states nearly all are.

    Attributes:
        states, channels: nx, c.
        used: indices into F | g | H, each by columns, of the elements that are kept.
    """

    states: int
    channels: int
    used: tuple[int, ...]

    def parts(self, kept: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """F, g and H as sparse matrices of the elements that are kept."""
        n, c = self.states, self.channels
        ends = np.cumsum([0, n * n, SOURCES * n, c * n]).tolist()
        whole = ca.SX(ca.Sparsity.triplet(ends[-1], 1, list(self.used), [0] * len(self.used)), kept)
        F, g, H = (whole[a:b] for a, b in pairwise(ends))
        return ca.reshape(F, n, n), ca.reshape(g, n, SOURCES), ca.reshape(H, c, n)


@dataclass(frozen=True, slots=True)
class Tangent:
    """How errors move along a free run.

    Attributes:
        values: shape (n, m), what is kept of F, (g_u, g_τ) and H at every sample.
        structure: which m elements that are.
    """

    values: F64
    structure: Structure


@cache
def _tangent_loop(plant: PlantModel, channels: tuple[str, ...]) -> tuple[SampleLoop, Structure]:
    """Along a free run: what is kept of F, the two noise gains and H."""
    n, row = len(plant.states), ca.SX.sym("row", 3)
    x, q = ca.SX.sym("x", n), ca.SX.sym("q", len(plant.parameters))
    u, t, h = row[INPUT], row[TIME], row[STEP]
    p = natural(plant, q)
    x_next = plant.step(x, u, p, t, h)
    shown = ca.vertcat(*[plant.sensed(x, p, t)[MEASURABLE.index(c)] for c in channels])
    per_input, gain = ca.jacobian(x_next, u), plant.noise_gain(x, u, p, t, h)
    # Dry friction that sticks lets nothing through: the share of the input's gain that is left is the torque's, too.
    speed = plant.state_names.index("velocity_rad_s")
    through = per_input[speed] / gain[speed, 0]
    parts = [ca.jacobian(x_next, x), per_input, gain[:, 1] * through, ca.jacobian(shown, x)]
    outputs = ca.vertcat(*[ca.vec(part) for part in parts])
    used, _ = outputs.sparsity().get_triplet()
    kept = ca.vertcat(*outputs.nonzeros())
    loop = SampleLoop(ca.Function("step", [x, q, row], ca.cse([x_next, kept])), paced_by=STEP)
    return loop, Structure(n, len(channels), tuple(used))


def tangent(plant: PlantModel, channels: tuple[str, ...], q: F64, x0: F64, rows: F64) -> Tangent:
    """F, (g_u, g_τ) and H at every sample of a free run."""
    loop, structure = _tangent_loop(plant, channels)
    return Tangent(loop.run(np.array(x0, dtype=np.float64), q, rows), structure)


@cache
def _filter_loop(structure: Structure, k: int) -> SampleLoop:
    """Measurement update channel by channel, then prediction, for k columns of data."""
    n, c, kept = structure.states, structure.channels, len(structure.used)
    n_tri = n * (n + 1) // 2
    state, variance = ca.SX.sym("state", n_tri + n * k), ca.SX.sym("variance", SOURCES + c)
    sample = ca.SX.sym("sample", kept + c + c * k)
    edges = np.cumsum([0, kept, c, c * k])
    model, weight, data = (sample[a:b] for a, b in pairwise(edges.tolist()))
    F, g, H = structure.parts(model)
    data = ca.reshape(data, k, c)
    P, xi = ca.tril2symm(ca.tril(_square(state[:n_tri], n))), ca.reshape(state[n_tri:], n, k)
    whitened, logs = [], []
    for m in range(c):
        valid = weight[m] > 0
        PHt = P @ H[m, :].T
        s = H[m, :] @ PHt + variance[SOURCES + m] / ca.if_else(valid, weight[m], 1.0)
        innovation = data[:, m].T - H[m, :] @ xi
        xi = xi + valid / s * (PHt @ innovation)
        P = P - valid / s * (PHt @ PHt.T)
        whitened.append(valid / ca.sqrt(s) * innovation.T)
        logs.append(valid * ca.log(s))
    noise = g @ ca.diag(variance[:SOURCES]) @ g.T
    P = F @ P @ F.T + noise
    lower = ca.vertcat(*[P[row, column] for column in range(n) for row in range(column, n)])
    next_state = ca.vertcat(lower, ca.vec(F @ xi))
    return SampleLoop(
        ca.Function("step", [state, variance, sample], ca.cse([next_state, ca.vertcat(*whitened, *logs)]))
    )


def _square(tri: ca.SX, n: int) -> ca.SX:
    P, at = ca.SX.zeros(n, n), 0
    for column in range(n):
        for row in range(column, n):
            P[row, column] = tri[at]
            at += 1
    return P


@dataclass(frozen=True, slots=True)
class Prepared:
    """Samples as the filter takes them, to be run with several variances.

    Attributes:
        samples: shape (n, m + c + c k): what is kept of the model, weights, k columns of data.
        structure: of the model.
        columns: k.
    """

    samples: F64
    structure: Structure
    columns: int

    def run(self, variance: F64) -> Whitened:
        """Through the filter, with variances as for `whiten`."""
        n, c, k = self.structure.states, self.structure.channels, self.columns
        out = _filter_loop(self.structure, k).run(np.zeros(n * (n + 1) // 2 + n * k), variance, self.samples)
        return Whitened(out[:, : c * k].reshape(-1, c, k), out[:, c * k :])


def prepare(model: Tangent, weights: F64, data: F64) -> Prepared:
    """For one or up to eight columns; arguments as for `whiten`."""
    rows, c, width = data.shape
    k, m = (1 if width == 1 else _BATCH), model.values.shape[1]
    samples = np.zeros((rows, m + c + c * k))
    samples[:, :m], samples[:, m : m + c] = model.values, weights
    samples[:, m + c :].reshape(rows, c, k)[:, :, :width] = data
    return Prepared(samples, model.structure, k)


def whiten(model: Tangent, weights: F64, data: F64, variance: F64) -> Whitened:
    """Run the filter over k columns.

    Args:
        model: over n samples.
        weights: shape (n, c); a channel's variance is divided by it, 0: not valid.
        data: shape (n, c, k).
        variance: shape (2 + c,): of w_u and w_τ, held over a step, then of each channel's noise.
    """
    k = data.shape[2]
    parts = [prepare(model, weights, data[:, :, b : b + _BATCH]).run(variance) for b in range(0, k, _BATCH)]
    return Whitened(np.concatenate([p.values for p in parts], axis=2)[:, :, :k], parts[0].log_variance)


def tangents(problem: Problem, unknowns: F64) -> tuple[Tangent, ...]:
    """`tangent` of every segment at these unknowns."""
    return tuple(
        tangent(
            problem.plant,
            problem.channels,
            problem.acting(unknowns, segment.recording),
            problem.initial_state(unknowns, k),
            segment.rows,
        )
        for k, segment in enumerate(problem.segments)
    )


def channel_weights(problem: Problem, weights: Sequence[F64]) -> tuple[F64, ...]:
    """The samples' weights, 0 where not valid."""
    return tuple(w * s.valid for w, s in zip(weights, problem.segments, strict=True))


def moving(problem: Problem) -> tuple[NDArray[np.bool_], ...]:
    """Valid samples of channels that do not stand on one value, per segment, shape (n, c): an encoder at rest repeats
    one rounding error and is no sample of a noise."""
    out = []
    for segment in problem.segments:
        mask = segment.valid.copy()
        for c in range(mask.shape[1]):
            values = np.where(segment.valid[:, c], segment.measured[:, c], np.nan)
            lengths = np.diff(np.flatnonzero(np.diff(values, prepend=np.nan, append=np.nan) != 0))
            mask[:, c] &= np.repeat(lengths <= _LONGEST_REPEAT, lengths)
        out.append(mask)
    return tuple(out)
