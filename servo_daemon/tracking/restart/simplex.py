"""The simplex search of Nelder and Mead (*Computer Journal* 7, 1965), one evaluation at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from servo_daemon.samples import F64


class SimplexSearch:
    """Of the least cost.

    Args:
        cost: of a point, shape (n,).
        simplex: points to begin with, shape (n + 1, n).
        exact, cost_exact: the last simplex is no larger than this, and its costs no further apart.
        most: evaluations.
    """

    def __init__(
        self, cost: Callable[[F64], float], simplex: F64, *, exact: float, cost_exact: float, most: int
    ) -> None:
        self._cost, self._simplex, self._costs = cost, simplex.copy(), np.full(len(simplex), np.inf)
        self._exact, self._cost_exact, self._left = exact, cost_exact, most

    @property
    def best(self) -> F64:
        """The point of the least cost so far, shape (n,)."""
        return np.asarray(self._simplex[int(np.argmin(self._costs))])

    def steps(self) -> Iterator[None]:
        """Stops after every evaluation, to be gone on with."""
        for k, point in enumerate(self._simplex):
            self._costs[k] = self._of(point)
            yield
        while True:
            order = np.argsort(self._costs, kind="stable")
            self._simplex, self._costs = self._simplex[order], self._costs[order]
            if self._left <= 0 or self._is_small():
                return
            yield from self._replace_worst()

    def _of(self, point: F64) -> float:
        self._left -= 1
        return self._cost(point)

    def _is_small(self) -> bool:
        size = np.max(np.abs(self._simplex[1:] - self._simplex[0]))
        return bool(size <= self._exact and np.max(self._costs) - self._costs[0] <= self._cost_exact)

    def _replace_worst(self) -> Iterator[None]:
        centre, worst = np.mean(self._simplex[:-1], axis=0), self._simplex[-1].copy()
        reflected = 2.0 * centre - worst
        cost = self._of(reflected)
        yield
        if self._costs[0] <= cost < self._costs[-2]:
            self._put_last(reflected, cost)
            return
        if cost < self._costs[0]:
            other, limit = 3.0 * centre - 2.0 * worst, cost
        elif cost < self._costs[-1]:
            other, limit = 1.5 * centre - 0.5 * worst, cost
        else:
            other, limit = 0.5 * centre + 0.5 * worst, float(self._costs[-1])
        if cost < self._costs[-1]:
            self._put_last(reflected, cost)
        if self._left <= 0:
            return
        other_cost = self._of(other)
        yield
        if other_cost < limit:
            self._put_last(other, other_cost)
        elif cost >= self._costs[0]:  # neither way is better: closer to the best
            for k in range(1, len(self._simplex)):
                if self._left <= 0:
                    return
                self._simplex[k] = 0.5 * (self._simplex[0] + self._simplex[k])
                self._costs[k] = self._of(self._simplex[k])
                yield

    def _put_last(self, point: F64, cost: float) -> None:
        self._simplex[-1], self._costs[-1] = point, cost
