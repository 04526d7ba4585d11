"""Tracking on data of the independent generator: how near the bound, how honest, and what a wrong model shows.

Short runs with fixed seeds of what `benchmarks/tracking` does at length.
"""

from __future__ import annotations

import numpy as np
import pytest

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.published.snapshot import Estimate
from servo_daemon.samples import make_block
from tests.recovery.generator import MOTORS, PAPER, Recording, Scenario, generate
from tests.recovery.tracking.ageing import ageing_run
from tests.recovery.tracking.bound import bound_run
from tests.recovery.tracking.follow import NAMES, tracked


@pytest.mark.parametrize("motor", ["paper", "re40", "gear", "large"])
def test_near_the_cramer_rao_bound(motor: str) -> None:
    """All variances known, random-walk ageing: nobody does better, and we hardly do worse. Far better would be a bug of
    the bound."""
    rmse, limit, inside, share = bound_run((motor, "multisine", 90.0, 7))
    ratio = rmse / limit
    assert np.median(ratio) < 1.3 and ratio.max() < 2.0, dict(zip(NAMES, ratio, strict=True))
    assert ratio.min() > 0.4
    assert 0.88 < inside <= 1.0
    assert (share > 0.9).all()


@pytest.mark.first_is_fast
@pytest.mark.parametrize(("motor", "motion"), [("paper", "multisine"), ("gear", "pick_and_place"), ("re40", "prbs")])
def test_follows_linear_ageing_with_honest_intervals(motor: str, motion: str) -> None:
    """Unknown noise, a quantised encoder, jitter; R +40 %, K −15 %, B +80 %, J +30 % in five minutes."""
    rms, inside, wide, tracking = ageing_run((motor, motion, 300.0, 11))
    assert (rms < [0.004, 0.03, 0.003, 0.004, 0.008]).all(), dict(zip(NAMES, rms, strict=True))
    assert (inside > 0.92).all(), dict(zip(NAMES, inside, strict=True))
    assert (wide[[0, 2, 3, 4]] < 3).all(), dict(zip(NAMES, wide, strict=True))
    assert (tracking > 0.9).all()


def estimates(recording: Recording, model: tuple[str, ...]) -> list[Estimate]:
    config = DriveConfig(model=model)
    pipeline = Pipeline(config, DriveInfo("test", counts_per_rev=float(recording.metadata["counts_per_rev"])))
    channels = {c: getattr(recording, c) for c in ("voltage_V", "current_A", "position_rad")}
    return pipeline.process(make_block(recording.time_s, **channels))


@pytest.mark.slow
def test_a_friction_that_is_not_in_the_model_is_seen_and_bends_little_else() -> None:
    """Event-driven stick-slip friction of 6 % of the working torque: the mismatch watch speaks; in the model it is
    silent and all is found."""
    Tc = 0.06 * PAPER.working_torque_Nm
    recording = generate(
        PAPER, Scenario("pick_and_place", seconds=40.0, effects={"coulomb_friction": {"Tc": Tc}}, seed=5)
    )
    without = estimates(recording, ())[-1]
    assert without.health["innovation_white"] is False
    electrical = {p.name: p.value for p in without.parameters}
    assert electrical["R"] == pytest.approx(PAPER.R, rel=0.03)
    within = estimates(recording, ("coulomb_friction",))[-1]
    found = {p.name: p for p in within.parameters}
    for name in ("R", "K", "J", "B"):
        assert found[name].value == pytest.approx(getattr(PAPER, name), rel=0.03), name
    assert found["Tc"].value == pytest.approx(Tc, rel=0.1)


def test_starts_from_nothing_on_every_motor() -> None:
    """No nominal values at all: tracking within 5 s, within 5 % (L: 20 %) after 15 s."""
    for motor in MOTORS.values():
        recording = generate(motor, Scenario("prbs", seconds=15.0, seed=3))
        track = tracked(recording, {})
        assert track.tracking[track.time_s > 5.0].mean() > 0.9, motor.name
        error = np.abs(track.value[-1] / [getattr(motor, name) for name in NAMES] - 1)
        assert (error < [0.05, 0.2, 0.05, 0.05, 0.1]).all(), (motor.name, error)
