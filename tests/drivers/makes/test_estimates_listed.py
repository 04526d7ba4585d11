"""VESC and ODrive from the wire to the estimate: simulated drive, driver and pipeline in lockstep on one clock."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from servo_daemon.config import parse_config
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import SampleBlock
from servo_daemon.sim_drive.makes.foc import FocDrive, Pmsm, RunningFoc
from servo_daemon.sim_drive.makes.odrive import OdriveNode
from servo_daemon.sim_drive.makes.vesc import VescDevice, VescNode
from tests.recovery.foc.lockstep import Clock, closed, closed_can, joined, polled
from tests.recovery.foc.played import bursts

MOTOR = Pmsm()
TRUTH = {"R": MOTOR.R, "L": MOTOR.L, "K": MOTOR.K_phase, "J": MOTOR.J, "B": MOTOR.B}


def estimated(driver: Any, blocks: Iterator[SampleBlock], nominal: Mapping[str, float] | None = None) -> dict[str, Any]:
    """What has been measured at the end, whether it is claimed or not."""
    table = {"name": "axis1", "driver": driver.kind, "options": driver.options, "nominal": dict(nominal or {})}
    pipeline: Pipeline | None = None
    for block in joined(blocks):
        if pipeline is None:
            pipeline = Pipeline(parse_config({"drive": [table]}).drive[0], driver.info, meaning=driver.meaning)
        pipeline.process(block, rows=False)
    assert pipeline is not None
    estimate = pipeline.finish() or pipeline.current()
    assert estimate is not None
    return {p.name: p for p in estimate.parameters if p.value is not None and p.std is not None}


def check(
    found: dict[str, Any], truth: Mapping[str, float], claimed: Mapping[str, float], measured: Mapping[str, float]
) -> None:
    """Those of `claimed` are, those of `measured` at least have a value, each so near; and whatever is claimed is
    within 4 of its std and 3 %."""
    assert {n for n, p in found.items() if p.status == "tracking"} >= set(claimed), found
    for name, share in {**claimed, **measured}.items():
        assert abs(found[name].value - truth[name]) <= share * truth[name], (name, found[name])
    for name, p in found.items():
        if p.status == "tracking" and name in truth:
            assert abs(p.value - truth[name]) <= 4.0 * p.std + 0.03 * truth[name], (name, p)


@pytest.mark.first_is_fast
@pytest.mark.parametrize(("rate_hz", "measured"), [(200.0, {"J": 0.02, "B": 0.03}), (50.0, {})])
def test_a_polled_vesc_tells_everything(rate_hz: float, measured: dict[str, float]) -> None:
    """The winding at any rate; the mechanics are measured from 200 Hz on, in these 20 s."""
    clock, driver = Clock(), closed("vesc", rate_hz=rate_hz)
    device = VescDevice(RunningFoc(FocDrive(MOTOR), clock))
    found = estimated(driver, polled(driver, driver._new_dialogue(), device, clock, rate_hz, round(20 * rate_hz)))
    check(found, TRUTH, {"R": 0.01, "K": 0.005}, measured)


@pytest.mark.first_is_fast
@pytest.mark.parametrize("rate_hz", [200.0, 1000.0])
def test_a_vesc_on_can_tells_what_its_steps_let_it(rate_hz: float) -> None:
    clock, driver = Clock(), closed_can("vesc", can_id=7)
    node = VescNode(RunningFoc(FocDrive(MOTOR), clock), rate_hz=rate_hz)
    found = estimated(driver, bursts(driver, node, clock, round(20 * rate_hz)))
    check(found, TRUTH, {"K": 0.02}, {})


def test_odrives_torque_tells_the_mechanics() -> None:
    clock, driver = Clock(), closed_can("odrive")
    node = OdriveNode(RunningFoc(FocDrive(MOTOR), clock), generation="0.6", node_id=5)
    found = estimated(driver, bursts(driver, node, clock, 3000))
    check(found, TRUTH, {"J": 0.02}, {})


def test_odrives_current_tells_the_mechanics_with_its_torque_constant() -> None:
    """K of the equivalent that is in use, `kt`: the drive's own torque constant, N·m a peak ampere."""
    clock, driver = Clock(), closed_can("odrive")
    node = OdriveNode(RunningFoc(FocDrive(MOTOR), clock), generation="0.5", node_id=5)
    found = estimated(driver, bursts(driver, node, clock, 3000), {"K": MOTOR.Kt})
    check(found, {**TRUTH, "K": MOTOR.Kt}, {"J": 0.02}, {})
