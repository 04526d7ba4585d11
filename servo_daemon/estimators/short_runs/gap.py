"""How wide a gap is: by runs in which the load crosses it, over all widths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servo_daemon.estimators.short_runs.runs import FEW_SAMPLES, LONG, MOST_SAMPLES
from servo_daemon.estimators.short_runs.search import cost, costs, settled_runs, within
from servo_daemon.estimators.short_runs.states import searched
from servo_daemon.estimators.short_runs.telling import RunSource
from servo_daemon.samples import F64

#: Groups of runs, each left out once.
_GROUPS = 5


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


def with_other_gap(source: RunSource, q: F64, scan: Scan) -> tuple[F64, float]:
    """The coordinates with the gap, of many, that suits longer runs best, and 1 σ of its logarithm by how far it would
    be another one for some of the runs (delete-group jackknife). Only runs in which the load crosses a gap tell how
    wide it is, each with edges of its own: a descent moves it by little at a time."""
    runs = source.in_swings(q, LONG, scan.samples)
    if runs is None:
        return q, np.inf
    settled, sigma = settled_runs(runs, q)
    at = source.problem.plant.parameter_names.index("gap")
    known: dict[float, F64] = {}

    def of_runs(log_factor: float) -> F64:
        if log_factor not in known:
            there = q.copy()
            there[at] += log_factor
            known[log_factor] = costs(runs, searched(runs, within(runs, there), settled.states, sigma))
        return known[log_factor]

    apart = 2.0 * scan.reach / (scan.tried - 1)
    tried = np.linspace(-scan.reach, scan.reach, scan.tried)
    while True:
        best = min(map(float, tried), key=lambda f: float(of_runs(f).sum()))
        if apart < scan.finest:
            break
        apart /= 3.0
        tried = best + apart * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    factors = np.array(sorted(known))
    table = np.stack([known[f] for f in factors.tolist()], axis=1)
    groups = [np.arange(len(table)) % _GROUPS == k for k in range(_GROUPS)]
    without = factors[[int(np.argmin(table[~g].sum(axis=0))) for g in groups]]
    spread = np.sqrt((_GROUPS - 1) / _GROUPS * np.sum((without - without.mean()) ** 2))
    out = q.copy()
    out[at] += factors[int(np.argmin(table.sum(axis=0)))]
    return within(runs, out), float(np.hypot(spread, apart))


def likelier(source: RunSource, one: F64, other: F64) -> bool:
    """Whether runs in which the load crosses its gap are likelier with these coordinates than with the others."""
    runs = source.in_swings(other, LONG, MOST_SAMPLES)
    if runs is None:
        return False
    settled, sigma = settled_runs(runs, other)
    return cost(runs, searched(runs, one, settled.states, sigma)) < cost(runs, settled)
