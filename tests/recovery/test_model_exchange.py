"""Another model while the drive runs, on motors of the independent generator that hide what the first model lacks."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.model_change import checked_request
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import make_block
from tests.recovery.generator import GEAR_MOTOR, PAPER, Motor, Scenario, generate, typical

pytestmark = pytest.mark.usefixtures("generator_built")


@pytest.mark.first_is_fast
@pytest.mark.parametrize("given", [True, False], ids=["given", "found"])
@pytest.mark.parametrize(
    ("motor", "motion", "effect", "share"),
    [
        (GEAR_MOTOR, "multisine", "coulomb_friction", 0.2),
        pytest.param(PAPER, "pick_and_place", "gravity_load", 0.2, marks=pytest.mark.slow),
    ],
    ids=["friction", "gravity"],
)
def test_the_innovations_turn_white_and_everything_is_found(
    motor: Motor, motion: str, effect: str, share: float, given: bool
) -> None:
    """With start values off by 2 % (3 σ of what a fit would claim at most), and without any: within ten seconds."""
    hidden = typical(effect, motor, share, seconds=27.0)
    recording = generate(motor, Scenario(motion, seconds=27.0, effects=hidden, seed=2))
    pipeline = Pipeline(DriveConfig(), DriveInfo("bench", counts_per_rev=float(recording.metadata["counts_per_rev"])))
    channels = {c: getattr(recording, c) for c in ("voltage_V", "current_A", "position_rad")}
    block = make_block(recording.time_s, **channels)
    before = pipeline.process(block.slice(0, 15_030))[-1]
    assert before.health["innovation_white"] is False
    truth: Mapping[str, float] = {n: float(v) for n, v in hidden[effect].items()}
    start = {n: (1.02 * v, 0.02 * abs(v)) for n, v in truth.items()} if given else {}
    request = checked_request((effect,), start)
    pipeline.change_model(request, request.configure(pipeline.config), None)
    after = pipeline.process(block.slice(15_030, len(block)))
    known = {p.name for p in before.parameters if p.status == "tracking"}
    assert {"R", "K"} <= known
    assert all(p.status == "tracking" for e in after for p in e.parameters if p.name in ("R", "K")), "never forgotten"
    last = after[-1]
    assert last.model == (effect,) and last.health["innovation_white"] is True and last.health["filter_restarts"] == 0
    for p in last.parameters:
        true = truth.get(p.name, getattr(motor, p.name, None))
        assert p.status == "tracking" and p.value is not None and p.std is not None and true is not None
        assert abs(p.value - true) < max(4 * p.std, 0.03 * abs(true)), p
