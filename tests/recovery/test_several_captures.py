"""Several captures, and what keeps a name from being given: order, captures that took no part, values that are open."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture, in_canonical_order
from servo_daemon.diagnosis.missing.missing import missing_inputs
from servo_daemon.diagnosis.search.evidence import half_convinces, noticeable
from servo_daemon.diagnosis.search.select import Selection
from servo_daemon.diagnosis.trial.compare import Advantage
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.diagnosis.trial.trial import Trial, first_trial, fit_trial
from servo_daemon.diagnosis.verdict.determined import is_determined
from servo_daemon.diagnosis.verdict.other_captures import helps_no_other
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.identification.output_error.problem.setup import make_problem
from servo_daemon.identification.output_error.solver.solver import within
from servo_daemon.identification.procedure.identify import IdentifyOptions, identify
from servo_daemon.samples import SampleBlock, make_block
from tests.recovery.generator import PAPER, EffectValues, Scenario, Sensors, generate

pytestmark = pytest.mark.usefixtures("generator_built")
_DRY = {"coulomb_friction": {"Tc": 0.3}}


def block_of(effects: dict[str, EffectValues], seed: int, *, seconds: float = 8.0, current: bool = True) -> SampleBlock:
    made = generate(PAPER, Scenario("multisine", seconds, 200.0, effects, sensors=Sensors.laboratory(PAPER), seed=seed))
    measured = {"current_A": made.current_A} if current else {}
    return make_block(made.time_s, voltage_V=made.voltage_V, position_rad=made.position_rad, **measured)


def capture_of(block: SampleBlock, name: str) -> Capture:
    return Capture(Path(name), block.time_s, block.voltage_V, block.current_A, block.position_rad)


def searched(blocks: list[SampleBlock], name: str) -> Selection:
    """As a search that has taken this effect would end."""
    recordings = [Recording(str(k), block) for k, block in enumerate(blocks)]
    data = Data.of(recordings, {}, (), segment_length_s(recordings))
    base = first_trial(data, (), {})
    chosen = fit_trial(data, (name,), {**base.values, "TL": 0.01, "Tc": 0.01, "w_c": 0.1})
    assert chosen is not None
    return Selection(data, base, chosen, (name,), (), {})


def test_the_order_of_captures_changes_nothing() -> None:
    captures = [capture_of(block_of(_DRY, seed, seconds=3.0), name) for seed, name in ((1, "b"), (2, "c"), (3, "a"))]
    paths = [c.path for c in in_canonical_order(captures)]
    assert all([c.path for c in in_canonical_order(order)] == paths for order in permutations(captures))
    one, other = (identify(c, (), IdentifyOptions(("coulomb_friction",), ())).fit for c in (captures, captures[::-1]))
    assert one.parameters == other.parameters


def test_the_order_does_not_hang_on_names() -> None:
    blocks = [block_of({}, seed, seconds=1.0) for seed in (1, 2)]
    one = in_canonical_order([capture_of(b, n) for b, n in zip(blocks, ("x", "y"), strict=True)])
    other = in_canonical_order([capture_of(b, n) for b, n in zip(blocks, ("y", "x"), strict=True)])
    assert [np.array_equal(a.voltage_V, b.voltage_V) for a, b in zip(one, other, strict=True)] == [True, True]


def test_a_cause_of_the_motor_helps_every_capture() -> None:
    assert helps_no_other(searched([block_of(_DRY, 1), block_of(_DRY, 2)], "coulomb_friction")) == ()


def test_a_load_that_each_capture_has_otherwise_helps_no_other() -> None:
    blocks = [block_of({"constant_load_torque": {"TL": load}}, seed) for seed, load in ((1, 0.4), (2, -0.4))]
    assert helps_no_other(searched(blocks, "constant_load_torque")) == ("constant_load_torque",)


def test_a_single_capture_has_no_other() -> None:
    assert helps_no_other(searched([block_of({}, 1)], "coulomb_friction")) == ()


def test_without_a_current_a_friction_is_known_as_its_voltage() -> None:
    recordings = [Recording("capture", block_of(_DRY, 1, current=False))]
    fit = fit_output_error(recordings, ("coulomb_friction",), FitOptions())
    assert fit.parameters["Tc"].status == "undetermined"
    assert is_determined("coulomb_friction", fit)


def test_a_spring_that_nothing_shows_is_not_determined() -> None:
    fit = fit_output_error([Recording("capture", block_of({}, 1))], ("shaft_compliance",), FitOptions())
    assert not is_determined("shaft_compliance", fit)


def test_no_winding_is_a_spring_where_no_current_is_measured() -> None:
    block = block_of({}, 1, seconds=2.0, current=False)
    problem = make_problem([Recording("capture", block)], (), {})
    start = problem.start(dict.fromkeys(problem.parameter_of_column, 0.0))
    at = [problem.free.index(name) for name in ("R", "L")]
    clipped = within(problem, start)
    assert np.exp(clipped[at[1]] - clipped[at[0]]) == pytest.approx(0.1)
    measured = make_problem([Recording("capture", block_of({}, 1, seconds=2.0))], (), {})
    assert within(measured, start)[at[1]] == start[at[1]]  # the current shows what its winding is


def test_nothing_that_warms_at_once_is_a_winding() -> None:
    block = block_of({}, 1)
    data = Data.of([Recording("capture", block)], {}, (), 0.5)
    base = first_trial(data, (), {})
    warm: Trial = replace(base, effects=("winding_heating",), values={**base.values, "R_th": 10.0, "C_th": 0.05})
    missing = missing_inputs(base, block)
    assert not noticeable("winding_heating", warm, missing)
    assert noticeable("winding_heating", replace(warm, values={**warm.values, "C_th": 5.0}), missing)


def test_a_step_of_a_hair_of_the_resistance_is_none() -> None:
    block = block_of({}, 1)
    data = Data.of([Recording("capture", block)], {}, (), 0.5)
    base = first_trial(data, (), {})
    missing = missing_inputs(base, block)
    for share, is_one in ((3e-4, False), (0.02, True)):
        stepped = replace(base, values={**base.values, "dR": -share * base.values["R"], "t_R": 3.0})
        assert noticeable("resistance_step", stepped, missing) is is_one


def test_a_lag_of_a_small_part_of_a_sample_is_none() -> None:
    block = block_of({}, 1)
    data = Data.of([Recording("capture", block)], {}, (), 0.5)
    base = first_trial(data, (), {})
    missing, period_s = missing_inputs(base, block), base.problem.sample_period_s
    for share, is_one in ((0.05, False), (0.5, True)):
        late = replace(base, values={**base.values, "t_lag": share * period_s})
        assert noticeable("drive_lag", late, missing) is is_one


def test_half_of_the_evidence_is_a_reason_to_look_beside() -> None:
    assert half_convinces(Advantage(gain=0.6, low=-0.2, high=1.0, delta_bic=-80.0))
    assert not half_convinces(Advantage(gain=0.6, low=0.3, high=1.0, delta_bic=3.0))
    assert not half_convinces(Advantage(gain=0.01, low=-0.2, high=1.0, delta_bic=-80.0))
