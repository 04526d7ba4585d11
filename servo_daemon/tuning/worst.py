"""The worst margins of one controller over a region of motors, by a deterministic search.

Regions lie in the logarithms of the parameters around the estimate: an ellipsoid from the estimate's covariance (its
correlations with it: R and K are hardly identifiable separately, and move together), or a box of tolerances. The search
evaluates the centre, the ends of the region's axes and quasi-random points (Sobol, unscrambled), then goes from the
worst of them by Frank–Wolfe steps: the gradient's worst point of the region, and points on the way to it (Frank &
Wolfe, *An algorithm for quadratic programming*, 1956), for each measure apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64
from servo_daemon.tuning.knowledge import NEEDED, PROBABILITY, MotorKnowledge, named
from servo_daemon.tuning.margins import MarginArrays, Margins

#: Points of the first look, beside centre and axes; Frank–Wolfe steps; shares of the way that each step tries.
_LOOK, _STEPS = 64, 5
_WAY = (1.0, 0.5, 0.2, 0.05)
_DIFFERENCE = 1e-4  # of the gradient, in the region's own coordinates
#: Measures, each looked for by itself; also the keys of `Worst.at`.
MEASURES = ("gain_margin_dB", "phase_margin_deg", "delay_margin_s", "sensitivity_peak")

Evaluate = Callable[[F64], MarginArrays]


class Region(Protocol):
    """A convex set of motors. Its own coordinates u, shape (n,), are 0 at the estimate and of size 1."""

    @property
    def names(self) -> tuple[str, ...]:
        """The uncertain parameters."""

    def motors(self, u: F64) -> F64:
        """Logarithms of R, L, K, J, B for these u, shape (m, n): shape (m, 5)."""

    def farthest(self, direction: F64) -> F64:
        """The u that is the farthest in each of these directions, shape (m, n)."""

    def spread(self, cube: F64) -> F64:
        """Points of the unit cube, shape (m, n), as points of the set."""

    @property
    def described(self) -> str:
        """The set in words."""


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """{center + spread_ u : |u| ≤ 1}: holds the motor with `PROBABILITY` if its logarithms are normal."""

    names: tuple[str, ...]
    center: F64
    matrix: F64  # shape (5, n)
    of: str  # what is uncertain, in words

    def motors(self, u: F64) -> F64:
        return np.asarray(self.center + u @ self.matrix.T)

    def farthest(self, direction: F64) -> F64:
        size = np.linalg.norm(direction, axis=1, keepdims=True)
        return np.asarray(direction / np.where(size > 0, size, 1.0))

    def spread(self, cube: F64) -> F64:
        """On the surface and, a quarter of them, at half of the way."""
        from scipy.special import ndtri

        u = self.farthest(ndtri(cube))
        u[::4] *= 0.5
        return u

    @property
    def described(self) -> str:
        n = len(self.names)
        return f"{PROBABILITY:.0%} ellipsoid of the logarithms of {self.of} (chi-square, {n} d.o.f.)"


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Each of `names` within P (1 ± tolerance), all combinations."""

    names: tuple[str, ...]
    center: F64
    tolerance: F64  # shape (n,), below 1

    def motors(self, u: F64) -> F64:
        out = np.repeat(self.center[None, :], len(u), axis=0)
        out[:, [NEEDED.index(name) for name in self.names]] += np.log1p(self.tolerance * u)
        return out

    def farthest(self, direction: F64) -> F64:
        return np.sign(direction)

    def spread(self, cube: F64) -> F64:
        """All corners, and points inside."""
        n = len(self.names)
        corners = 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1) - 1.0
        return np.concatenate((corners, 2.0 * cube - 1.0))

    @property
    def described(self) -> str:
        return "tolerances " + ", ".join(
            f"{name} ± {100 * t:.3g} %" for name, t in zip(self.names, self.tolerance, strict=True)
        )


def region_of(knowledge: MotorKnowledge, tolerance: Mapping[str, float] | None = None) -> Region | None:
    """The region in which the motor is: of its covariance; where it has none, of the tolerances; None without both.

    Args:
        tolerance: by name, relative, in (0, 1).
    """
    center = knowledge.log_values
    if knowledge.uncertain:
        from scipy.special import chdtri

        radius = float(np.sqrt(chdtri(len(knowledge.uncertain), 1.0 - PROBABILITY)))
        values, vectors = np.linalg.eigh(knowledge.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))  # not Cholesky: the matrix may be singular
        matrix = np.zeros((len(NEEDED), len(knowledge.uncertain)))
        matrix[[NEEDED.index(name) for name in knowledge.uncertain]] = radius * root
        of = "gain and lags of speed per voltage" if knowledge.answer else ", ".join(knowledge.uncertain)
        return Ellipsoid(knowledge.uncertain, center, matrix, of)
    if tolerance:
        names = tuple(name for name in NEEDED if name in tolerance)
        return Box(names, center, np.array([tolerance[name] for name in names]))
    return None


@dataclass(frozen=True, slots=True)
class Worst:
    """The worst that the region holds, each measure by itself.

    Attributes:
        margins: as in `Margins`; `stable` false if any motor of the region makes the loop unstable.
        at: where each measure is the worst: parameters by name.
    """

    margins: Margins
    at: Mapping[str, Mapping[str, float]]


def worst_case(evaluate: Evaluate, region: Region) -> Worst:
    """Search the region.

    Args:
        evaluate: margins of motors, logarithms of R, L, K, J, B, shape (m, 5).
    """
    u = _first_look(region, len(region.names))
    found = evaluate(region.motors(u))
    seen_u, seen = [u], [found]
    values = _scores(found)
    best = u[values.argmin(axis=1)]  # one start for each measure, (4, n), and all from the centre
    best = np.concatenate((best, np.zeros((len(MEASURES), best.shape[1]))))
    score = np.concatenate((values.min(axis=1), values[:, 0]))
    measure = np.tile(np.arange(len(MEASURES)), 2)
    for _ in range(_STEPS):
        tried = _step(evaluate, region, best, score, measure)
        seen_u.append(tried.u)
        seen.append(tried.found)
        better = tried.score < score - 1e-9 * (1.0 + np.abs(score))
        best = np.where(better[:, None], tried.best, best)
        score = np.where(better, tried.score, score)
        if not better.any():
            break
    return _collect(region, np.concatenate(seen_u), seen)


def _first_look(region: Region, n: int) -> F64:
    """Centre first, then both ends of each axis, then the spread points."""
    axes = np.eye(n)
    return np.concatenate((np.zeros((1, n)), axes, -axes, region.spread(_sobol(n).copy())))


@lru_cache
def _sobol(n: int) -> F64:
    """Low-discrepancy points inside the unit cube, shape (`_LOOK`, n)."""
    from scipy.stats.qmc import Sobol

    return np.asarray(np.clip(Sobol(n, scramble=False).random(_LOOK) + 0.5 / _LOOK, 1e-6, 1.0 - 1e-6))


@dataclass(frozen=True, slots=True, eq=False)
class _Tried:
    u: F64
    found: MarginArrays
    best: F64
    score: F64


def _step(evaluate: Evaluate, region: Region, best: F64, score: F64, measure: NDArray[np.intp]) -> _Tried:
    """One Frank–Wolfe step of every start: forward differences, then points on the way to the linear worst."""
    starts, n = best.shape
    inward = np.where(best > 0, -_DIFFERENCE, _DIFFERENCE)  # differences stay in a box
    shifted = (best[:, None, :] + inward[:, :, None] * np.eye(n)).reshape(-1, n)
    at_shifted = _scores(evaluate(region.motors(shifted))).reshape(len(MEASURES), starts, n)
    slope = (at_shifted[measure, np.arange(starts)] - score[:, None]) / inward
    goal = region.farthest(-slope)
    way = np.array(_WAY)[None, :, None]
    u = (best[:, None, :] + way * (goal - best)[:, None, :]).reshape(-1, n)
    found = evaluate(region.motors(u))
    values = _scores(found).reshape(len(MEASURES), starts, len(_WAY))[measure, np.arange(starts)]
    choice = values.argmin(axis=1)
    return _Tried(
        u, found, u.reshape(starts, len(_WAY), n)[np.arange(starts), choice], values[np.arange(starts), choice]
    )


def _scores(found: MarginArrays) -> F64:
    """Shape (4, m): smaller is worse; where unstable, below zero by how far."""
    with np.errstate(divide="ignore"):
        gain = np.minimum(np.log(found.up), -np.log(found.down))
    margin = np.array([np.minimum(gain, 50.0), np.minimum(found.phase_rad, np.pi), found.delay_s, found.distance])
    margin = np.where(np.isfinite(margin), margin, 1e6)
    return np.asarray(np.where(found.stable, margin, 1.0 - found.radius))


def _collect(region: Region, u: F64, seen: list[MarginArrays]) -> Worst:
    parts = {name: np.concatenate([getattr(a, name) for a in seen]) for name in MarginArrays.__dataclass_fields__}
    every = MarginArrays(**parts)
    where = _scores(every).argmin(axis=1)
    motors = region.motors(u[where])
    at = {name: named(x) for name, x in zip(MEASURES, motors, strict=True)}
    if not every.stable.all():
        return Worst(Margins(False, None, None, None, None, None, None), at)
    smallest = MarginArrays(
        up=every.up.min(keepdims=True),
        down=every.down.max(keepdims=True),
        phase_rad=every.phase_rad.min(keepdims=True),
        delay_s=every.delay_s.min(keepdims=True),
        distance=every.distance.min(keepdims=True),
        crossover_rad_s=every.crossover_rad_s[:1],
        radius=every.radius.max(keepdims=True),
    )
    return Worst(replace(smallest.of(0), crossover_hz=None), at)
