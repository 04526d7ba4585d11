"""Windows that go wrong on purpose, and motors outside the range: what a model learns to decline."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.learning.examples.drawing import CORE, TrainingSpec, draw_outside, draw_parameters
from servo_daemon.learning.examples.faults import FAULTS, with_fault
from servo_daemon.learning.examples.training import FAULTY, FOREIGN, HEALTHY, simulate_motors
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.simulate import PAPER_MOTOR

SPEC = TrainingSpec(dict(PAPER_MOTOR), window_s=2.0, rate_hz=500.0)


@pytest.fixture
def block() -> SampleBlock:
    t = np.arange(2000) / 1000.0
    return make_block(t, voltage_V=np.sin(9 * t) + 2.0, current_A=np.cos(9 * t), position_rad=np.sin(3 * t))


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_every_fault_changes_the_channel_and_is_finite(name: str, block: SampleBlock) -> None:
    assert block.current_A is not None
    for seed in range(20):
        changed = FAULTS[name](np.random.default_rng(seed), block.current_A)
        assert changed.shape == block.current_A.shape
        assert np.isfinite(changed).all()
        assert np.abs(changed - block.current_A).max() > 0.005


def test_one_channel_goes_wrong_and_the_window_itself_stays(block: SampleBlock) -> None:
    before = {c: getattr(block, c).copy() for c in block.channels}
    seen = set()
    for seed in range(200):
        changed, name = with_fault(block, np.random.default_rng(seed))
        different = [c for c in block.channels if not np.array_equal(getattr(changed, c), before[c])]
        assert len(different) == 1
        seen.add((different[0], name))
    assert len(seen) == 3 * len(FAULTS)
    assert all(np.array_equal(getattr(block, c), before[c]) for c in block.channels)


def test_motors_outside_lie_outside() -> None:
    core = draw_parameters(SPEC, 200)
    nominal = np.array([SPEC.nominal[n] for n in CORE])
    away = np.array([np.abs(np.log(draw_outside(SPEC, k, core[k]) / nominal)) for k in range(200)]) / np.log(
        SPEC.spread
    )
    assert (away.max(axis=1) >= 1.0 + np.log(1.4) / np.log(3.0) - 1e-9).all()
    assert set((away > 1.0).sum(axis=1)) == {1, 2}


def test_novel_windows_stand_beside_the_healthy_ones_which_stay_the_same() -> None:
    core = draw_parameters(SPEC, 12)
    alone, beside = (simulate_motors(SPEC, range(12), core, novel=s) for s in (False, True))
    healthy = beside.only(beside.kind == HEALTHY)
    assert np.array_equal(healthy.features, alone.features, equal_nan=True)
    assert np.array_equal(healthy.truth, alone.truth)
    assert {HEALTHY, FAULTY, FOREIGN} == set(beside.kind.tolist())
    foreign = beside.only(beside.kind == FOREIGN)
    assert not np.isin(foreign.truth[:, 0], alone.truth[:, 0]).all()
