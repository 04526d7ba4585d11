"""Standard deviations from parts of the data that have nothing in common.

Behind a gap a free run is no smooth function of the parameters: teeth that meet a moment later meet at another speed,
and what follows is another motion. The sum of squares has steps and valleys of its own, closer together than what its
slopes can see, and a standard deviation from slopes knows nothing of them. Parts of the recording have other valleys.
Each is fitted for itself, and how far apart they end is what the fit leaves open, whatever the reason (a delete-group
jackknife: Shao & Wu, *Annals of Statistics* 17, 1989). With e_b the estimate of a part, H_b what it tells (its initial
states eliminated) and H = Σ H_b, the estimate from all is near H⁻¹ Σ H_b e_b, and its covariance

    n/(n − 1) H⁻¹ (Σ s_b s_bᵀ) H⁻¹,  s_b = H_b (e_b − e)

so that a part in which nothing moves counts for nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error.precision.information import reduced
from servo_daemon.identification.output_error.problem.linearisation import Linearisation
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.solver.solver import Point, solve
from servo_daemon.samples import F64

#: Parts, each of consecutive pieces; fewer that could be fitted tell no spread. And iterations of each.
_PARTS, _FEWEST, _ITERATIONS = 5, 3, 4
#: A direction that says less than this share of the strongest, in logarithms, says nothing.
_NOTHING = 1e-10


def spread_std(problem: Problem, point: Point) -> F64 | None:
    """1 σ of the shared parameters' coordinates by how parts of the recording differ, shape (n_shared,); None: they are
    too few to tell.

    Args:
        point: where the fit to all of them has ended.
    """
    groups = np.array_split(np.arange(len(problem.segments)), _PARTS)
    found = [told for g in groups if len(g) and (told := _of_part(problem, point, g)) is not None]
    if len(found) < _FEWEST:
        return None
    inverse = np.linalg.pinv(np.sum([H for H, _ in found], axis=0), rcond=_NOTHING, hermitian=True)
    scores = np.stack([H @ moved for H, moved in found], axis=1)
    root = inverse @ scores * np.sqrt(len(found) / (len(found) - 1))
    return np.asarray(np.linalg.norm(root, axis=1)[: problem.n_shared])


def _of_part(problem: Problem, point: Point, chosen: NDArray[np.intp]) -> tuple[F64, F64] | None:
    """What a part tells of k parameters, shape (k, k), and by how much its own estimate differs, shape (k,); None where
    it cannot be simulated."""
    part, here = _taken(problem, point, [int(k) for k in chosen])
    triangle = reduced(part, here)[:, : len(problem.parameter_of_column)]
    found = solve(part, here.unknowns, max_iterations=_ITERATIONS, curved=False)
    if found is None:
        return None
    n = len(problem.parameter_of_column)
    return triangle.T @ triangle, found.point.unknowns[:n] - here.unknowns[:n]


def _taken(problem: Problem, point: Point, chosen: list[int]) -> tuple[Problem, Point]:
    """Some of the segments, and the same point there."""
    n, states = len(problem.parameter_of_column), len(problem.plant.states)
    segments = tuple(problem.segments[k] for k in chosen)
    part = replace(problem, segments=segments, whole=_until(problem, segments))
    begins = [point.unknowns[n + k * states : n + (k + 1) * states] for k in chosen]
    linear = Linearisation(
        tuple(point.linearisation.residuals[k] for k in chosen),
        tuple(point.linearisation.jacobian[k] for k in chosen),
        True,
    )
    unknowns, weights = np.concatenate([point.unknowns[:n], *begins]), tuple(point.weights[k] for k in chosen)
    return part, replace(point, unknowns=unknowns, linearisation=linear, weights=weights)


def _until(problem: Problem, segments: tuple[Segment, ...]) -> tuple[tuple[F64, F64], ...]:
    """Runs over the recordings as far as these segments need them."""
    ends = [max((s.begin + 1 for s in segments if s.recording == k), default=1) for k in range(len(problem.whole))]
    return tuple((x0, rows[:end]) for (x0, rows), end in zip(problem.whole, ends, strict=True))
