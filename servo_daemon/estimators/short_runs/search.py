"""Parameters of a motor with a load behind a gap, by short runs whose initial states are searched for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.estimators.base import natural_values, to_coordinate
from servo_daemon.estimators.output_error.problem import Problem
from servo_daemon.estimators.short_runs.runs import Runs, can_be_searched
from servo_daemon.estimators.short_runs.states import Settled, descended, eliminated, floor, searched
from servo_daemon.samples import F64

#: Runs, in times of the teeth's own swing (2π/ω): so short that a load meets its teeth about once, for what the teeth
#: are like; so long that it crosses the gap, for how wide that is and for the end. Never fewer samples.
_SHORT, _LONG, _FEWEST = 4.0, 16.0, 30
#: Samples that are searched in the end, and those to begin with.
_MOST_SAMPLES, _FEW_SAMPLES = 12_000, 5_000
#: Groups of runs, each left out once.
_GROUPS = 5
#: Loads as shares of all inertia, on teeth that swing like this, so damped, that a search begins at, and samples that
#: tell which of them is best.
_SHARES, _TEETH_RAD_S, _TEETH_DAMPING, _FEWEST_SAMPLES = (0.15, 0.4), (200.0, 450.0), 0.15, 2_500
#: Rounds of a search, steps in each, tries of a step.
_TIMES, _BEGINNING_ROUNDS, _ROUNDS, _STEPS, _TRIES = 2, 2, 2, 6, 5
#: No logarithm moves further in a step; differences are so much of one.
_LONGEST, _DIFFERENCE = 0.5, 3e-3
_FIRST_DAMPING, _LEAST_DAMPING, _HARDER = 1e-2, 1e-6, 8.0
#: A step that gains less is the last of its round, and a round that moves nothing by so many standard deviations, or
#: by this share, the last.
_LITTLE, _STILL_STDS, _STILL = 2.0, 0.3, 1e-4
#: Noise of a sensor to begin with, as a share of its signal.
_FINE = 1e-4
#: Of its curvature a parameter has at least this share of the largest.
_FLAT = 1e-12
#: A run's slopes count for no more than so many times those of the steepest tenth.
_STEEPEST, _TENTH = 3.0, 0.9


@dataclass(frozen=True, slots=True)
class _Scan:
    """Gaps that are tried beside the present one: so many, as far to either side (in logarithms), then closer ones
    around the best until they are so close; over so many samples."""

    reach: float
    tried: int
    finest: float
    samples: int


_FAR, _NEAR, _NEAREST = (
    _Scan(2.4, 13, 0.05, _FEW_SAMPLES),
    _Scan(0.3, 7, 0.03, _MOST_SAMPLES),
    _Scan(0.06, 5, 6e-3, _MOST_SAMPLES),
)


@dataclass(frozen=True)
class ShortRunFit:
    """Where a search has ended.

    Attributes:
        q: shape (np,), the plant's coordinates.
        columns: which of them were free.
        covariance: of these, from how far the runs disagree.
        sigma: shape (c,), what the best quarter of the runs leaves.
        value: −2 log p of the runs with a variance for each, but for a constant.
        runs, settled: the runs and their states.
    """

    q: F64
    columns: tuple[int, ...]
    covariance: F64
    sigma: F64
    value: float
    runs: Runs
    settled: Settled

    def with_gap(self, column: int, std: float) -> ShortRunFit:
        """The same, the gap known to 1 σ of its logarithm."""
        n = len(self.columns)
        covariance = np.zeros((n + 1, n + 1))
        covariance[:n, :n], covariance[n, n] = self.covariance, std**2
        return replace(self, columns=(*self.columns, column), covariance=covariance)

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


def begun_short_runs(problem: Problem, start: Mapping[str, float], rigid_J: float) -> dict[str, float] | None:
    """Where a fit is to begin, natural units: from values that may be several times too large or too small. None: the
    model or the data are none for it.

    Args:
        problem: of one recording; its segments are cut up, its free parameters searched for.
        start: of all parameters; loads and teeth of other sizes are tried as well.
        rigid_J: motor and load together.
    """
    if "gap" not in problem.free or not can_be_searched(problem):
        return None
    columns = _columns(problem)
    q = _best_begun(problem, coordinates_of(problem, start), columns, rigid_J)
    for _ in range(_TIMES):  # how long a run is to be hangs on what is searched for
        short = _runs(problem, q, _SHORT, _FEW_SAMPLES)
        if short is None:
            return None
        q = _search(short, q, columns, _BEGINNING_ROUNDS).q
    q, _ = _other_gap(problem, q, _FAR)
    short = _runs(problem, q, _SHORT, _FEW_SAMPLES)
    return None if short is None else _search(short, q, _but_the_gap(problem), 1).values


def fit_short_runs(problem: Problem, start: Mapping[str, float]) -> ShortRunFit | None:
    """Fit from values that are about right; None: the model or the data are none for it. See `begun_short_runs`."""
    if "gap" not in problem.free or not can_be_searched(problem):
        return None
    q, found, gap_std = coordinates_of(problem, start), None, np.inf
    for scan in (_NEAR, _NEAREST):  # a gap a little wrong bends the teeth, and these the gap
        q, gap_std = _other_gap(problem, q, scan)
        runs = _runs(problem, q, _SHORT, _MOST_SAMPLES)
        if runs is None:
            return None
        found = _search(runs, q, _but_the_gap(problem), _ROUNDS)
        q = found.q
    return None if found is None else found.with_gap(problem.plant.parameter_names.index("gap"), gap_std)


def likelier(problem: Problem, one: F64, other: F64) -> bool:
    """Whether runs in which the load crosses its gap are likelier with these coordinates than with the others."""
    runs = _runs(problem, other, _LONG, _MOST_SAMPLES)
    if runs is None:
        return False
    settled, sigma = settled_runs(runs, other)
    return _cost(runs, searched(runs, one, settled.states, sigma)) < _cost(runs, settled)


def coordinates_of(problem: Problem, values: Mapping[str, float]) -> F64:
    """Of natural values, shape (np,)."""
    return np.array([to_coordinate(p, values[p.name]) for p in problem.plant.parameters])


def _columns(problem: Problem) -> tuple[int, ...]:
    """Which of the plant's parameters are free."""
    return tuple(problem.plant.parameter_names.index(n) for n in problem.free)


def _but_the_gap(problem: Problem) -> tuple[int, ...]:
    """The same without the gap: short runs hardly cross it, and a descent moves it by little."""
    names = problem.plant.parameter_names
    return tuple(k for k in _columns(problem) if names[k] != "gap")


def _best_begun(problem: Problem, q: F64, columns: Sequence[int], rigid_J: float) -> F64:
    """The best of a few steps from here and from other loads on other teeth."""
    names = problem.plant.parameter_names
    runs = Runs.of(problem, _SHORT * 2 * np.pi / max(_TEETH_RAD_S), _FEWEST_SAMPLES, _FEWEST)
    if runs is None:
        return q
    starts = [q]
    for share in _SHARES:
        for omega in _TEETH_RAD_S:
            other = q.copy()
            J, J_l = (1.0 - share) * rigid_J, share * rigid_J
            k_s = J * share * omega**2  # against the reduced inertia
            for name, value in {"J": J, "J_l": J_l, "k_s": k_s, "c_s": 2 * _TEETH_DAMPING * k_s / omega}.items():
                if name in problem.free:
                    other[names.index(name)] = np.log(value)
            starts.append(_within(runs, other))
    found = [_search(runs, s, columns, 1) for s in starts]
    return min(found, key=lambda f: f.value).q


def _runs(problem: Problem, q: F64, swings: float, most_samples: int) -> Runs | None:
    """Runs of so many of the teeth's own swings."""
    p = natural_values(problem.plant.parameters, q)
    mu = p["J"] * p["J_l"] / (p["J"] + p["J_l"])
    return Runs.of(problem, swings * 2 * np.pi * float(np.sqrt(mu / p["k_s"])), most_samples, _FEWEST)


def _search(runs: Runs, q: F64, columns: Sequence[int], rounds: int) -> ShortRunFit:
    """Rounds of: states searched anew, noise told from the best runs, parameters moved with the states following."""
    settled, sigma = settled_runs(runs, q)
    result = None
    for number in range(rounds):
        if number:
            sigma = floor(runs, settled, sigma)
            settled = searched(runs, q, settled.states, sigma)
        before = q
        place, covariance = _moved(runs, _Place(q, settled, _cost(runs, settled)), columns, sigma)
        q, settled = place.q, place.settled
        value = place.cost + 2.0 * float(runs.valid.sum(axis=(0, 1)) @ np.log(sigma))
        result = ShortRunFit(q, tuple(columns), covariance, sigma, value, runs, settled)
        moved = np.abs(q - before)[list(columns)]
        if (moved <= np.maximum(_STILL_STDS * np.sqrt(np.diag(covariance)), _STILL)).all():
            break
    assert result is not None
    return result


def settled_runs(runs: Runs, q: F64) -> tuple[Settled, F64]:
    """States that suit the runs, and the noise of the best of these."""
    sigma = _FINE * runs.scale[[runs.plant.state_names.index(c) for c in runs.channels]]
    settled = searched(runs, q, runs.guessed, sigma)
    sigma = floor(runs, settled, sigma)
    return searched(runs, q, settled.states, sigma), sigma


def _cost(runs: Runs, settled: Settled) -> float:
    """Of all runs together, see `_costs`."""
    return float(_costs(runs, settled).sum())


def _costs(runs: Runs, settled: Settled) -> F64:
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
            q = _within(runs, q)
            there = descended(runs, q, place.settled.states, sigma, 3)
            cost = _cost(runs, there)
            if cost < place.cost:
                better = _Place(q, there, cost)
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


def _within(runs: Runs, q: F64) -> F64:
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


def _other_gap(problem: Problem, q: F64, scan: _Scan) -> tuple[F64, float]:
    """The coordinates with the gap, of many, that suits longer runs best, and 1 σ of its logarithm by how far it would
    be another one for some of the runs (delete-group jackknife). Only runs in which the load crosses a gap tell how
    wide it is, each with edges of its own: a descent moves it by little at a time."""
    runs = _runs(problem, q, _LONG, scan.samples)
    if runs is None:
        return q, np.inf
    settled, sigma = settled_runs(runs, q)
    at, costs = problem.plant.parameter_names.index("gap"), {}

    def of_runs(log_factor: float) -> F64:
        if log_factor not in costs:
            there = q.copy()
            there[at] += log_factor
            costs[log_factor] = _costs(runs, searched(runs, _within(runs, there), settled.states, sigma))
        return costs[log_factor]

    apart = 2.0 * scan.reach / (scan.tried - 1)
    tried = np.linspace(-scan.reach, scan.reach, scan.tried)
    while True:
        best = min(map(float, tried), key=lambda f: float(of_runs(f).sum()))
        if apart < scan.finest:
            break
        apart /= 3.0
        tried = best + apart * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    factors = np.array(sorted(costs))
    table = np.stack([costs[f] for f in factors.tolist()], axis=1)
    groups = [np.arange(len(table)) % _GROUPS == k for k in range(_GROUPS)]
    without = factors[[int(np.argmin(table[~g].sum(axis=0))) for g in groups]]
    spread = np.sqrt((_GROUPS - 1) / _GROUPS * np.sum((without - without.mean()) ** 2))
    out = q.copy()
    out[at] += factors[int(np.argmin(table.sum(axis=0)))]
    return _within(runs, out), float(np.hypot(spread, apart))
