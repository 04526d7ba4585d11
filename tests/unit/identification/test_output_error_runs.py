"""Many short free runs: their equations solved block by block, and those that began in the wrong place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.identification.output_error import Recording
from servo_daemon.identification.output_error.diverged_segments import grown
from servo_daemon.identification.output_error.problem.setup import make_problem
from servo_daemon.identification.output_error.solver.bordered import solve_bordered
from tests.unit.identification.test_output_error import FULL, MOTOR, block_of, linear_recording


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


def test_a_run_whose_beginning_is_held_out_is_begun_from_what_is_seen() -> None:
    """A diagnosis holds samples out: the first fifth of a run may show nothing at all of any sensor."""
    signals = linear_recording(0.4, noise=1e-4)
    seen = np.arange(400) >= 150
    problem = make_problem((Recording("a", block_of(signals, *FULL), seen),), (), MOTOR)
    assert problem.counts.tolist() == [250, 250]
    found = grown(replace(problem, segments=(replace(problem.segments[0], x0=np.zeros(3)),)), 0)
    assert found is not None
    assert np.isfinite(found[0]).all()
    assert np.sqrt(np.mean(found[1][150:] ** 2, axis=0)) == pytest.approx([1e-3, 1e-4], rel=0.2)  # noise is left
