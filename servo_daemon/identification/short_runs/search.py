"""The parameters that suit runs best whose initial states are searched for, from given ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.identification.short_runs.runs import Runs
from servo_daemon.identification.short_runs.states import Settled, descended, eliminated, first_sigma, floor, searched
from servo_daemon.kalman.gaussian import natural_values, to_coordinate
from servo_daemon.samples import F64

#: Steps in a round, tries of a step.
_STEPS, _TRIES = 6, 5
#: No logarithm moves further in a step; differences are so much of one.
_LONGEST, _DIFFERENCE = 0.5, 3e-3
_FIRST_DAMPING, _LEAST_DAMPING, _HARDER = 1e-2, 1e-6, 8.0
#: A step that gains less is the last of its round, and a round that moves nothing by so many standard deviations, or
#: by this share, the last.
_LITTLE, _STILL_STDS, _STILL = 2.0, 0.3, 1e-4
#: Of its curvature a parameter has at least this share of the largest.
_FLAT = 1e-12
#: A run's slopes count for no more than so many times those of the steepest tenth.
_STEEPEST, _TENTH = 3.0, 0.9


@dataclass(frozen=True)
class ShortRunFit:
    """Where a search has ended.

    Attributes:
        q: shape (np,), the plant's coordinates.
        columns: which of them were free.
        covariance: of these, from how far the runs disagree.
        value: −2 log p of the runs with a variance for each, but for a constant.
        runs: what was searched.
        settled: their states there.
        sigma: shape (c,), the noise told from the best of them.
    """

    q: F64
    columns: tuple[int, ...]
    covariance: F64
    value: float
    runs: Runs
    settled: Settled
    sigma: F64

    def following(self, column: int) -> F64:
        """How all coordinates move where one that is not free is another by 1, the free ones suiting the runs, shape
        (np,): runs that tell little of a gap have teeth as stiff as it lets them be."""
        place, which = _Place(self.q, self.settled, cost(self.runs, self.settled)), list(self.columns)
        H, _ = _information(self.runs, place, (*which, column), self.sigma)
        move = np.zeros(len(self.q))
        move[which], move[column] = -np.linalg.pinv(H[:-1, :-1], hermitian=True) @ H[:-1, -1], 1.0
        return move

    def with_gap(self, column: int, std: float) -> ShortRunFit:
        """The same, the gap known to 1 σ of its logarithm, and the others no better than that lets them be."""
        columns = (*self.columns, column)
        move = self.following(column)[list(columns)]
        covariance = std**2 * np.outer(move, move)
        covariance[:-1, :-1] += self.covariance
        return replace(self, columns=columns, covariance=covariance)

    @property
    def values(self) -> dict[str, float]:
        """Natural values of all parameters."""
        return natural_values(self.runs.plant.parameters, self.q)


@dataclass(frozen=True)
class _Place:
    """Coordinates, the runs' states there, and what that costs."""

    q: F64
    settled: Settled
    cost: float


def search(runs: Runs, q: F64, columns: Sequence[int], rounds: int) -> ShortRunFit:
    """Rounds of: states searched anew, noise told from the best runs, parameters moved with the states following."""
    settled, sigma = settled_runs(runs, q)
    result = None
    for number in range(rounds):
        if number:
            sigma = floor(runs, settled, sigma)
            settled = searched(runs, q, settled.states, sigma)
        before = q
        place, covariance = _moved(runs, _Place(q, settled, cost(runs, settled)), columns, sigma)
        q, settled = place.q, place.settled
        value = place.cost + 2.0 * float(runs.valid.sum(axis=(0, 1)) @ np.log(sigma))
        result = ShortRunFit(q, tuple(columns), covariance, value, runs, settled, sigma)
        moved = np.abs(q - before)[list(columns)]
        if (moved <= np.maximum(_STILL_STDS * np.sqrt(np.diag(covariance)), _STILL)).all():
            break
    assert result is not None
    return result


def settled_runs(runs: Runs, q: F64) -> tuple[Settled, F64]:
    """States that suit the runs, and the noise of the best of these."""
    sigma = first_sigma(runs)
    settled = searched(runs, q, runs.guessed, sigma)
    sigma = floor(runs, settled, sigma)
    return searched(runs, q, settled.states, sigma), sigma


def cost(runs: Runs, settled: Settled) -> float:
    """Of all runs together, see `costs`."""
    return float(costs(runs, settled).sum())


def costs(runs: Runs, settled: Settled) -> F64:
    """−2 log p of runs of which each has a variance of its own, never below the floor: most runs are explained to
    their noise, and one whose load is in the wrong place says little."""
    n = runs.counts
    with np.errstate(over="ignore"):
        return np.asarray(n * np.log1p(np.minimum(settled.squares, 1e300) / n))


def _moved(runs: Runs, place: _Place, columns: Sequence[int], sigma: F64) -> tuple[_Place, F64]:
    """Some damped Gauss–Newton steps of the parameters, each judged with the states that then suit the runs. And the
    covariance where they end."""
    damping, which = _FIRST_DAMPING, list(columns)
    for _ in range(_STEPS):
        H, scores = _information(runs, place, which, sigma)
        better = None
        for _ in range(_TRIES):
            size = np.maximum(np.diag(H), _FLAT * np.max(np.diag(H), initial=1.0))
            step = np.linalg.solve(H + damping * np.diag(size), scores.sum(axis=0))
            q = place.q.copy()
            q[which] += np.clip(step, -_LONGEST, _LONGEST)
            q = within(runs, q)
            there = descended(runs, q, place.settled.states, sigma, 3)
            reached = cost(runs, there)
            if reached < place.cost:
                better = _Place(q, there, reached)
                break
            damping *= _HARDER
        if better is None:
            break
        gained, place = place.cost - better.cost, better
        damping = max(damping / _HARDER, _LEAST_DAMPING)
        if gained < _LITTLE:
            break
    H, scores = _information(runs, place, which, sigma)
    inverse = np.linalg.pinv(H, hermitian=True)
    return place, np.asarray(inverse @ (scores.T @ scores) @ inverse)


def within(runs: Runs, q: F64) -> F64:
    """Coordinates within the parameters' bounds."""
    low, high = (
        [to_coordinate(p, b) for p, b in zip(runs.plant.parameters, bounds, strict=True)]
        for bounds in ([p.lower for p in runs.plant.parameters], [p.upper for p in runs.plant.parameters])
    )
    return np.asarray(np.clip(q, low, high))


def _information(runs: Runs, place: _Place, columns: Sequence[int], sigma: F64) -> tuple[F64, F64]:
    """Gauss–Newton's matrix, shape (p, p), and what each run says, shape (k, p), initial states eliminated."""
    r = place.settled.residuals
    good = np.isfinite(place.settled.squares)
    r = np.where(good[:, None], r, 0.0)
    J = runs.by_states(place.q, place.settled.states, sigma, r)
    G = runs.by_parameters(place.q, place.settled.states, sigma, r, columns, _DIFFERENCE)
    fine = good & np.isfinite(J).all(axis=(1, 2)) & np.isfinite(G).all(axis=(1, 2))
    J, G = (np.where(fine[:, None, None], a, 0.0) for a in (J, G))
    J[~fine] = np.eye(J.shape[1], J.shape[2])
    G, r = eliminated(J, G, r)
    n = runs.counts
    weight = 1.0 / (1.0 + np.where(good, place.settled.squares, np.inf) / n)
    H = np.einsum("k,kni,knj->kij", weight, G, G)
    scores = np.einsum("k,kni,kn->ki", weight, G, r)
    # A run beside an edge (teeth that just meet, or just do not) has slopes beyond all others.
    steep = np.einsum("kii->k", H)
    most = _STEEPEST * float(np.quantile(steep, _TENTH))
    weight = np.minimum(1.0, most / np.maximum(steep, 1e-300))
    return np.asarray(np.einsum("k,kij->ij", weight, H)), np.asarray(weight[:, None] * scores)
