"""The 95 % band of a free run over a capture that was not fitted.

What the parameters' covariance (as published, with its misfit) and a friction that changes from day to day make of the
run, to first order by its sensitivities, and what the model leaves of the captures that it was fitted to, noise and
misfit alike, give the band its shape. Its size is that which holds 95 % of the samples of every other piece of 0.2 s;
it is used for the pieces between, so that no sample has a say in its own band. What the shape alone promises, without a
look at the errors, is what the rms error is expected to be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error import OutputErrorFit, Recording
from servo_daemon.identification.output_error.problem.inputs import input_rows
from servo_daemon.identification.output_error.problem.rollout import simulate
from servo_daemon.identification.output_error.problem.score import Interval, measured_start, score
from servo_daemon.identification.procedure.settle import DRY, VISCOUS
from servo_daemon.samples import F64, SampleBlock

#: 1 σ of one scale of all friction from day to day: on the EMPS benchmark's second capture it is 2.5 to 3 % higher.
_DAY = 0.03
#: 1 σ of the logarithm of what a model leaves from one motion to another: between the halves of one capture of the EMPS
#: axis it is 1.1 to 1.8 times as much, of the generator's belt servo under multisines 0.8 to 1.15.
_MOTION = 0.25
#: Share of samples, or days, that a band holds.
_COVERED = 0.95
#: Pieces that have no say in their own band, s: longer than an error's ripple lasts. Of 10 s these are 50, of which the
#: half says a 95 % quantile; of pieces of 1 s five would, and the band of an angle, which drifts, be missed by 15 %.
_PIECE_S = 0.2
_DRAWS, _SEED = 400, 11


@dataclass(frozen=True, slots=True)
class Bands:
    """Of n samples.

    Attributes:
        channels: of the columns.
        half: shape (n, c), half the width.
        error: shape (n, c), simulated − measured.
        expected: shape (c, 2), between what an rms error lies in 95 % of the days if nothing but that changed.
    """

    channels: tuple[str, ...]
    half: F64
    error: F64
    expected: F64

    def intervals(self) -> dict[str, Interval]:
        """The band of each channel."""
        inside = np.mean(np.abs(self.error) <= self.half, axis=0)
        width = np.sqrt(np.mean(np.square(self.half), axis=0))
        return {
            name: Interval(float(width[k]), float(inside[k]), (float(self.expected[k, 0]), float(self.expected[k, 1])))
            for k, name in enumerate(self.channels)
        }


def bands_of(
    block: SampleBlock, fit: OutputErrorFit, q: F64, fitted: Sequence[Recording], *, another_day: bool = True
) -> Bands | None:
    """The bands of a model's free run; None where it leaves the range of numbers.

    Args:
        q: shape (np,), coordinates of the plant's parameters: the fit's, or what they have settled at.
        fitted: the recordings of the fit.
        another_day: friction may have changed since; False: it has settled on this one.
    """
    plant = fit.problem.plant
    channels, measured, states = measured_start(block, plant, q)
    left = _left(channels, fit, fitted)
    run = simulate(plant, channels, q, states[0], np.ascontiguousarray(input_rows(block, plant.drive)))
    moves = run.by_parameter @ _root(fit, another_day=another_day)
    error = run.shown - measured
    if not (np.isfinite(moves).all() and np.isfinite(error).all()):
        return None
    variance = np.sum(np.square(moves), axis=2)
    # What is off by another cause than these parameters does not vanish where they happen to have no effect.
    so_far = np.cumsum(variance, axis=0) / np.arange(1, len(block) + 1)[:, None]
    shape = np.sqrt((variance + so_far) / 2 + np.square(left))
    half = _sized(block, np.abs(error) / np.maximum(shape, 1e-300)) * shape
    return Bands(channels, half, error, _expected(moves, left))


def _left(channels: tuple[str, ...], fit: OutputErrorFit, fitted: Sequence[Recording]) -> F64:
    """RMS of what the model leaves of its own captures, shape (c,)."""
    squares = []
    for k, recording in enumerate(fitted):
        found = score(recording.block, fit.problem.plant, fit.coordinates(k))
        squares.append([np.square(found.rmse.get(name, 0.0)) for name in channels])
    return np.asarray(np.sqrt(np.average(squares, axis=0, weights=[len(r.block) for r in fitted])))


def _root(fit: OutputErrorFit, *, another_day: bool) -> F64:
    """Shape (np, ·), of the covariance of the plant's coordinates: root rootᵀ."""
    names = fit.problem.plant.parameter_names
    columns = fit.after.names
    root = np.zeros((len(names), fit.after.root.shape[1]))
    for k, name in enumerate(columns[: fit.problem.n_shared]):
        root[names.index(name)] = fit.after.root[k]
    local = [k for k, name in enumerate(columns) if k >= fit.problem.n_shared]
    for k in local:  # an offset of its own for every recording: the mean of them is used
        root[names.index(columns[k])] += fit.after.root[k] / fit.problem.recordings
    day = np.array([[_DAY] if another_day and name in (*DRY, *VISCOUS) else [0.0] for name in names])
    return np.hstack([root, day])


def _sized(block: SampleBlock, ratio: F64) -> F64:
    """The factor of every sample, shape (n, c): of even pieces what holds 95 % of the odd ones, and the other way."""
    n = len(ratio)
    count = max(2, round(float(block.time_s[-1] - block.time_s[0]) / _PIECE_S))
    edges = np.linspace(0, n, count + 1).astype(int)
    odd: NDArray[np.bool_] = np.zeros(n, dtype=np.bool_)
    for k, (begin, end) in enumerate(pairwise(edges.tolist())):
        odd[begin:end] = k % 2 == 1
    out = np.empty_like(ratio)
    out[odd] = np.quantile(ratio[~odd], _COVERED, axis=0)
    out[~odd] = np.quantile(ratio[odd], _COVERED, axis=0)
    return out


def _expected(moves: F64, left: F64) -> F64:
    """Quantiles of the rms error, shape (c, 2), by draws of what moves the run, beside what is left of any."""
    rng = np.random.default_rng(_SEED)
    z = rng.standard_normal((_DRAWS, moves.shape[2]))
    another_motion = np.exp(2 * _MOTION * rng.standard_normal(_DRAWS))
    out = np.empty((moves.shape[1], 2))
    for c in range(moves.shape[1]):
        gram = moves[:, c].T @ moves[:, c] / len(moves)
        square = np.einsum("dk,kl,dl->d", z, gram, z) + left[c] ** 2 * another_motion
        out[c] = np.sqrt(np.quantile(np.maximum(square, 0.0), [(1 - _COVERED) / 2, (1 + _COVERED) / 2]))
    return out
