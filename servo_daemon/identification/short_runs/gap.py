"""How wide a gap is: by runs in which the load crosses it, over all widths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servo_daemon.identification.short_runs.informative import RunSource
from servo_daemon.identification.short_runs.runs import FEW_SAMPLES, LONG, MOST_SAMPLES, Runs
from servo_daemon.identification.short_runs.search import cost, costs, settled_runs, within
from servo_daemon.identification.short_runs.states import Settled, descended, searched
from servo_daemon.samples import F64

#: Groups of runs, each left out once.
_GROUPS = 5
#: Of two fits that are compared: from the one to the other.
_BETWEEN = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True, slots=True)
class Scan:
    """Gaps that are tried beside the present one: so many, as far to either side (in logarithms), then closer ones
    around the best until they are so close; over so many samples."""

    reach: float
    tried: int
    finest: float
    samples: int


FAR, NEAR, NEAREST = (
    Scan(2.4, 13, 0.05, FEW_SAMPLES),
    Scan(0.3, 7, 0.03, MOST_SAMPLES),
    Scan(0.06, 5, 6e-3, MOST_SAMPLES),
)


def with_other_gap(source: RunSource, q: F64, scan: Scan, move: F64 | None = None) -> tuple[F64, float]:
    """The coordinates with the gap, of many, that suits longer runs best, and 1 σ of its logarithm by how far it would
    be another one for some of the runs (delete-group jackknife). Only runs in which the load crosses a gap tell how
    wide it is, each with edges of its own: a descent moves it by little at a time.

    Args:
        move: shape (np,), how all coordinates move with the gap's; None: they stay.
    """
    runs = source.in_swings(q, LONG, scan.samples)
    if runs is None:
        return q, np.inf
    if move is None:
        move = np.eye(len(q))[source.problem.plant.parameter_names.index("gap")]
    line = _Line(runs, q, move, *settled_runs(runs, q))
    factors, table = line.searched(scan)
    groups = [np.arange(len(table)) % _GROUPS == k for k in range(_GROUPS)]
    without = factors[[int(np.argmin(table[~g].sum(axis=0))) for g in groups]]
    spread = np.sqrt((_GROUPS - 1) / _GROUPS * np.sum((without - without.mean()) ** 2))
    best = int(np.argmin(table.sum(axis=0)))
    return line.at(factors[best]), float(np.hypot(spread, np.diff(factors).min()))


@dataclass(frozen=True)
class _Line:
    """Runs at coordinates on a line, and the states that suit them somewhere on it, told with this noise."""

    runs: Runs
    q: F64
    move: F64
    settled: Settled
    sigma: F64

    def at(self, step: float) -> F64:
        """Coordinates so many moves from where the line begins, shape (np,)."""
        return within(self.runs, self.q + step * self.move)

    def searched(self, scan: Scan) -> tuple[F64, F64]:
        """Logarithms of factors that were tried, shape (m,), and what each run costs there, shape (k, m)."""
        apart = 2.0 * scan.reach / (scan.tried - 1)
        known = self.settled_at(np.linspace(-scan.reach, scan.reach, scan.tried).tolist())
        while apart >= scan.finest:
            best = min(known, key=lambda f: cost(self.runs, known[f]))
            apart /= 3.0
            for f in (best + apart * np.array([-2.0, -1.0, 1.0, 2.0])).tolist():
                known[f] = Settled.at(self.runs, self.at(f), known[best].states, self.sigma)
            self._exchange(known)
        factors = sorted(known)
        return np.array(factors), np.stack([costs(self.runs, known[f]) for f in factors], axis=1)

    def settled_at(self, factors: Sequence[float]) -> dict[float, Settled]:
        """States that suit the runs at these places, searched for at each of them."""
        known = {f: searched(self.runs, self.at(f), self.settled.states, self.sigma) for f in factors}
        self._exchange(known)
        return known

    def _exchange(self, known: dict[float, Settled]) -> None:
        """Let every run go on from where it is at the next factor, up and down: a search from places all over the gap
        misses the right one now and then, and what a few runs cost then is many times what a gap a little wrong costs.
        """
        factors = sorted(known)
        for order in (factors, factors[::-1]):
            for before, here in pairwise(order):
                there = descended(self.runs, self.at(here), known[before].states, self.sigma)
                known[here] = known[here].or_better(there)


def likelier(source: RunSource, one: F64, other: F64) -> bool:
    """Whether runs in which the load crosses its gap are likelier with these coordinates than with the others."""
    runs = source.in_swings(other, LONG, MOST_SAMPLES)
    if runs is None:
        return False
    known = _Line(runs, other, one - other, *settled_runs(runs, other)).settled_at(_BETWEEN)
    return cost(runs, known[_BETWEEN[-1]]) < cost(runs, known[_BETWEEN[0]])
