"""What a recording determines: singular values of the sensitivities, null directions, standard deviations.

The initial states (and each recording's own offsets) are eliminated by QR, segment by segment: what is left, R, has
RᵀR = the Fisher information of the parameters with those unknown (Golub & Van Loan, *Matrix Computations*, 4th ed.
2013, sec. 5.3). Its singular value decomposition shows the directions: 1/s is the standard deviation along each, in
logarithms. QR of the sensitivities instead of their squares keeps a direction that is exactly null apart from one that
is a billion times weaker than the strongest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import NumericalError
from servo_daemon.identification.output_error.problem.problem import Problem
from servo_daemon.identification.output_error.solver.solver import Point
from servo_daemon.samples import F64

#: A singular value this much smaller than the largest is rounding.
_RANK = 1e-7
#: A direction along which the data leave more than a factor of e (1 σ) is not determined.
_UNKNOWN = 1.0
#: Components smaller than this have no part in a null direction, nor do those that move a parameter by less than this
#: share of its own 1 σ: a direction that the data show at 1e-8 of the others (L held at nearly nothing) is not clean.
_COMPONENT, _OF_ITS_STD = 1e-6, 0.1
#: Part of a gradient along a direction without a trace beyond which a combination is open (chosen; not tried).
_LEAK = 1e-4
#: What a torque, an inertia or a stiffness is compared with where its own unit is open: without a current (the voltage
#: that overcomes it, N·m Ω/(N·m/A)), without a voltage (its current), without either (its acceleration).
_RELATIVE_TO: tuple[Mapping[str, float], ...] = ({}, {"R": 1.0, "K": -1.0}, {"K": -1.0}, {"J": -1.0})


@dataclass(frozen=True, slots=True)
class NullDirection:
    """A direction in which the parameters may move without a trace.

    Attributes:
        components: share of each parameter's coordinate, the largest 1; those below 1 % are left out.
        exact: nothing at all is seen along it; otherwise 1 σ is more than a factor of e.
    """

    components: dict[str, float]
    exact: bool


@dataclass(frozen=True, slots=True)
class Information:
    """What is known about the free parameters (shared, then each recording's own), coordinates scaled by `scale`.

    Attributes:
        names: of the columns.
        root: shape (k, ·), of the covariance of the coordinates: root rootᵀ, with nothing along exact null directions.
            Kept apart because a direction may be ten million times as uncertain as another, which its square drowns.
        undetermined: shape (k,), whether a null direction moves it or its own 1 σ exceeds a factor of e.
        null: the null directions.
        exact: shape (·, k), the exact ones as unit vectors in scaled coordinates.
        scale: shape (k,), of these.
    """

    names: tuple[str, ...]
    root: F64
    undetermined: NDArray[np.bool_]
    null: tuple[NullDirection, ...]
    exact: F64
    scale: F64

    @property
    def covariance(self) -> F64:
        """Shape (k, k)."""
        return np.asarray(self.root @ self.root.T)


def information(problem: Problem, point: Point, scale: F64) -> Information:
    """At one point, with the residuals' RMS there as the noise.

    Args:
        scale: shape (k,), size of one unit of each coordinate: 1 for a logarithm.

    Raises:
        NumericalError: sensitivities have left the range of numbers.
    """
    names = problem.parameter_of_column
    if not names:  # every parameter is given
        none = np.zeros((0, 0))
        return Information(names, none, np.zeros(0, dtype=bool), (), none, scale)
    seen = reduced(problem, point)[:, : len(names)] * scale
    if not np.isfinite(seen).all():
        raise NumericalError("what the parameters do to the simulation has left the range of numbers")
    _, s, directions = np.linalg.svd(seen)
    exact = s < _RANK * max(float(s[0]), 1e-300)
    with np.errstate(divide="ignore"):
        spread = np.where(exact, 0.0, 1.0 / np.where(exact, 1.0, s))
    root = (directions.T * spread)[:, ~exact]
    std = np.linalg.norm(root, axis=1)
    lost = (np.abs(directions[exact]) > np.maximum(_COMPONENT, _OF_ITS_STD * std)).any(axis=0)
    null = [
        NullDirection(_components(names, v), bool(e))
        for v, e, d in zip(directions, exact, spread, strict=True)
        if e or d > _UNKNOWN
    ]
    return Information(names, scale[:, None] * root, lost | (std > _UNKNOWN), tuple(null), directions[exact], scale)


def wider(info: Information, std: Mapping[int, float]) -> Information:
    """With 1 σ of some coordinates no smaller than this, by what is correlated with nothing.

    Args:
        std: by column, in the coordinate's unit.
    """
    known = np.sqrt(np.maximum(np.diag(info.covariance), 0.0))
    added = np.zeros((len(known), len(std)))
    for k, (column, least) in enumerate(std.items()):
        added[column, k] = np.sqrt(max(least**2 - known[column] ** 2, 0.0))
    return replace(info, root=np.hstack([info.root, added]))


def log_std(info: Information, name: str, value: float | None = None) -> float:
    """1 σ of a parameter's logarithm: its own, or as a multiple of the motor's if that is known better.

    Where no channel fixes the unit of torque, a torque's own is open without its being any less there.

    Args:
        value: of one whose coordinate is no logarithm, natural unit, not 0.
    """
    weight = 1.0 if value is None else 1.0 / value
    return min(_std_along(info, {name: weight, **others}) for others in _RELATIVE_TO)


def _std_along(info: Information, weights: Mapping[str, float]) -> float:
    """1 σ of a sum of coordinates; infinite where nothing is seen along a part of it."""
    gradient = np.array([weights.get(name, 0.0) for name in info.names])
    scaled = gradient * info.scale
    leak = float(np.max(np.abs(info.exact @ scaled), initial=0.0))
    if leak > _LEAK * float(np.linalg.norm(scaled)):
        return math.inf
    return float(np.linalg.norm(gradient @ info.root))


def _components(names: tuple[str, ...], direction: F64) -> dict[str, float]:
    largest = direction[np.argmax(np.abs(direction))]
    shares = direction / largest
    out: dict[str, float] = {}
    for name, share in zip(names, shares, strict=True):
        if abs(share) >= 0.01:
            out.setdefault(name, float(share))
    return out


def reduced(problem: Problem, point: Point) -> F64:
    """R over (parameters), initial states eliminated; shape (at least k, k)."""
    n_x, n_q = len(problem.plant.states), len(problem.parameter_of_column)
    _, prior = problem.state_prior
    parts = []
    for k, (J, w) in enumerate(zip(point.linearisation.jacobian, point.weights, strict=True)):
        where = problem.columns(k)
        A = (J * (np.sqrt(w) / point.sigma)[:, :, None]).reshape(-1, J.shape[2])
        states = np.vstack([A[:, -n_x:], np.diag(np.sqrt(prior[where[-n_x:]]))])
        others = np.vstack([A[:, :-n_x], np.zeros((n_x, A.shape[1] - n_x))])
        # Scaled states: their units (A, rad/s, rad) must not decide what counts as rounding.
        size = np.maximum(np.linalg.norm(states, axis=0), 1e-300)
        R = _triangle(np.hstack([states / size, others]))[n_x:, n_x:]
        wide = np.zeros((R.shape[0], n_q))
        wide[:, where[:-n_x]] = R
        parts.append(wide)
    stacked = np.vstack([*parts, np.zeros((n_q, n_q))])
    return _triangle(stacked)


def _triangle(A: F64) -> F64:
    return np.asarray(np.linalg.qr(A, mode="r"), dtype=np.float64)


def sandwich(problem: Problem, point: Point, info: Information) -> F64:
    """Root of the covariance for residuals that are not white, H⁻¹ M H⁻¹ with M the long-run covariance of the scores.

    M = (1/n) Σ_ω J(ω)ᴴ W S(ω) W J(ω), S the residuals' spectral matrix over all channels, smoothed (Daniell) over √n
    frequencies: correlation in time and between channels is in it, whatever made it (voltage noise, quantisation,
    what the model lacks). Formed along the root of H⁻¹, where white residuals give the unit matrix.
    """
    M = np.zeros((info.root.shape[1], info.root.shape[1]))
    for k, scores in enumerate(_reduced_sensitivities(problem, point)):
        r = point.linearisation.residuals[k] * np.sqrt(point.weights[k]) / point.sigma
        M += _long_run(scores @ info.root, r)
    values, vectors = np.linalg.eigh(M)
    return np.asarray(info.root @ (vectors * np.sqrt(np.maximum(values, 0.0))))


def largest(root: F64, other: F64) -> F64:
    """Root of the smallest covariance along these axes that is in every direction as large as both; shape as `root`.

    Args:
        root, other: of covariances over the same directions.
    """
    if not root.size:
        return root
    relative, *_ = np.linalg.lstsq(root, other, rcond=None)
    values, vectors = np.linalg.eigh(relative @ relative.T)
    return np.asarray(root @ (vectors * np.sqrt(np.maximum(values, 1.0))))


def _reduced_sensitivities(problem: Problem, point: Point) -> list[F64]:
    """Per segment, shape (n, c, k): weighted sensitivities less what the segment's initial state explains of them."""
    n_x, out = len(problem.plant.states), []
    for k, (J, w) in enumerate(zip(point.linearisation.jacobian, point.weights, strict=True)):
        where = problem.columns(k)
        A = (J * (np.sqrt(w) / point.sigma)[:, :, None]).reshape(-1, J.shape[2])
        states, others = A[:, -n_x:], A[:, :-n_x]
        size = np.maximum(np.linalg.norm(states, axis=0), 1e-300)
        explained, *_ = np.linalg.lstsq(states / size, others, rcond=1e-10)
        wide = np.zeros((len(A), len(problem.parameter_of_column)))
        wide[:, where[:-n_x]] = others - (states / size) @ explained
        out.append(wide.reshape(len(J), J.shape[1], -1))
    return out


def _long_run(scores: F64, residuals: F64) -> F64:
    n, c = residuals.shape
    length = 1 << (2 * n - 1).bit_length()
    E, D = np.fft.rfft(residuals, length, axis=0), np.fft.rfft(scores, length, axis=0)
    cross = E[:, :, None] * E[:, None, :].conj() / n
    width = max(3, int(np.sqrt(n) * length / n) | 1)
    S = _smoothed(cross, width)
    double = np.full(len(E), 2.0)
    double[[0, -1]] = 1.0
    # J_c(ω)* S_cd(ω) J_d(ω), summed over channels and frequencies; Parseval's factor 1/length.
    M = np.einsum("wcp,wcd,wdq,w->pq", D.conj(), S, D, double, optimize=True).real / length
    return np.asarray((M + M.T) / 2) if c else M


def _smoothed(values: np.ndarray, width: int) -> np.ndarray:
    """Moving mean over frequencies; at the ends over what there is (mirrored)."""
    reach = width // 2
    padded = np.concatenate([values[reach:0:-1].conj(), values, values[-2 : -2 - reach : -1].conj()])
    sums = np.cumsum(np.concatenate([np.zeros_like(padded[:1]), padded]), axis=0)
    return np.asarray((sums[width:] - sums[:-width]) / width)
