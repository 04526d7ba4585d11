"""Many short free runs: their equations solved block by block, and those that began in the wrong place."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error.solver.bordered import solve_bordered


@pytest.mark.parametrize("held", [(), (1,), (0, 2, 5)])
@pytest.mark.parametrize("parameters", [0, 3])
def test_bordered_equations_as_by_one_dense_solve(parameters: int, held: tuple[int, ...]) -> None:
    rng, blocks, states = np.random.default_rng(3), 7, 2
    n = parameters + blocks * states
    H = np.diag(rng.uniform(1.0, 2.0, n))
    for k in range(blocks):
        where = np.r_[0:parameters, parameters + k * states : parameters + (k + 1) * states]
        A = rng.normal(size=(9, len(where)))
        H[np.ix_(where, where)] += A.T @ A
    g, added = rng.normal(size=n), rng.uniform(0.1, 1.0, n)
    free = np.ones(n, dtype=bool)
    free[list(held)] = False
    expected = np.zeros(n)
    expected[free] = np.linalg.solve((H + np.diag(added))[np.ix_(free, free)], g[free])
    assert solve_bordered(H, g, free, added, parameters, states) == pytest.approx(expected, rel=1e-10, abs=1e-12)
