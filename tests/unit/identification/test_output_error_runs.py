"""Many short free runs: their equations solved block by block, and those that began in the wrong place."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from servo_daemon.identification.output_error import Recording
from servo_daemon.identification.output_error.diverged_segments import grown
from servo_daemon.identification.output_error.problem import rollout
from servo_daemon.identification.output_error.problem.setup import carrying, make_problem
from servo_daemon.identification.output_error.solver.bordered import solve_bordered
from servo_daemon.samples import F64
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


def test_states_along_a_long_run_are_those_of_the_run_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem((Recording("a", block_of(linear_recording(0.1), *FULL)),), ("winding_heating",), {})
    (segment,), plant = problem.segments, problem.plant
    q = np.array([[np.log(p.nominal) + 0.1 * k for p in plant.parameters] for k in range(3)])
    at = np.array([0, 6, 7, 8, 50])
    monkeypatch.setattr(rollout, "_AT_ONCE", 7)
    found = rollout.free_states(plant, problem.channels, q, segment.x0, segment.rows, at)
    for own, states in zip(q, found, strict=True):
        assert np.array_equal(states, rollout.free_run(plant, problem.channels, own, segment.x0, segment.rows)[1][at])
    assert not np.array_equal(found[0], found[1])


def test_initial_states_make_no_other_run_over_the_whole_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = [Recording("a", block_of(linear_recording(2.0, noise=1e-3), *FULL))]
    heated = ("winding_heating",)
    problem = carrying(make_problem(recordings, heated, {}, segment_s=0.5), recordings)
    runs, states = [], rollout.free_states

    def counted(*arguments: Any) -> F64:
        runs.append(arguments)
        return states(*arguments)

    monkeypatch.setattr("servo_daemon.identification.output_error.problem.problem.free_states", counted)
    nominal = {p.name: math.log(p.nominal) if p.transform == "log" else p.nominal for p in problem.plant.parameters}
    one = problem.start(nominal)
    other, hotter = one.copy(), one.copy()
    other[len(problem.parameter_of_column) :] += 0.1
    hotter[problem.free.index("R")] += 0.1
    first, same, changed = (problem.carried(unknowns) for unknowns in (one, other, hotter))
    assert len(runs) == 2
    assert np.array_equal(cast(Any, first), cast(Any, same))
    assert not np.array_equal(cast(Any, first), cast(Any, changed))
