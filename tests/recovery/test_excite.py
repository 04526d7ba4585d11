"""What a plan promises, measured on the independent generator's motor against its multisine of equal length and limits.

`benchmarks/excite.py` prints the same with more seeds.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.recovery.excitation_trials import determined, judged, limits, planned, played, rival
from tests.recovery.generator import RE40

pytestmark = [pytest.mark.usefixtures("generator_built"), pytest.mark.slow, pytest.mark.timeout(600)]
_SEED = 0


@pytest.mark.parametrize(
    ("true", "other", "share"),
    [
        ("stribeck_friction", "coulomb_friction", 0.02),
        ("load_dependent_friction", "coulomb_friction", 0.01),
        ("stribeck_friction", "asymmetric_friction", 0.02),
    ],
)
def test_causes_that_a_multisine_leaves_open_are_told_apart(true: str, other: str, share: float) -> None:
    before = judged(RE40, rival(RE40, _SEED), true, other, share, _SEED)
    assert not before.separated, "the pair is not hard: the test shows nothing"
    plan = planned(RE40, between=(true, other))
    after = judged(RE40, plan.reference, true, other, share, _SEED)
    assert after.separated
    assert after.against.gain > 2 * before.against.gain


def test_a_weak_inductance_becomes_known_at_least_twice_as_well() -> None:
    """L/R of this motor is 0.29 ms, sampled every millisecond."""
    before = determined(RE40, rival(RE40, _SEED), _SEED)["L"]
    after = determined(RE40, planned(RE40, wanted=("L",)).reference, _SEED)["L"]
    assert before.std is not None and after.std is not None and after.value is not None
    assert after.std < before.std / 2
    assert abs(after.value - RE40.L) < 4 * after.std


def test_a_motor_that_the_plan_does_not_know_stays_within_the_limits() -> None:
    """The plan was made for nominal values that are 4 to 15 % off; the generator's motor is the true one."""
    bound, plan = limits(RE40), planned(RE40)
    block = played(RE40, plan.reference, {}, _SEED)
    assert block.voltage_V is not None and block.current_A is not None
    # the drive has clipped nothing: its current limit would have lowered the voltage
    assert np.abs(block.voltage_V - plan.reference).max() <= RE40.supply_V / 2**14 + 1e-9
    assert np.abs(block.current_A).max() <= 1.05 * bound.current_A
    assert np.sqrt(np.mean(block.current_A**2)) <= 1.05 * bound.current_rms_A
