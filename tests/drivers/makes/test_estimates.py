"""From the wire of each make to the estimate: simulated drive, driver and pipeline in lockstep on one clock."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import pytest

from drivers.base import Driver
from drivers.cia402.drive import Cia402Driver
from servo_daemon.samples import SampleBlock
from servo_daemon.sim_drive.makes.catalogue import ACTUATOR, SLOW
from servo_daemon.sim_drive.makes.cia402 import Cia402Node
from servo_daemon.sim_drive.makes.foc import FocDrive, Pmsm, RunningFoc
from servo_daemon.sim_drive.makes.mit import MitActuator
from servo_daemon.sim_drive.makes.moteus import Fdcanusb, Moteus
from servo_daemon.sim_drive.makes.moving import FocMotor, MovingMotor
from servo_daemon.sim_drive.makes.servos import DynamixelChain, FeetechChain
from servo_daemon.sim_drive.makes.simplefoc import SimpleFocMonitor
from servo_daemon.simulate import SimulatedDrive, make_settings
from servo_daemon.simulate.settings import PAPER_MOTOR
from tests.drivers.makes.can_rig import batch
from tests.recovery.foc.lockstep import Clock, claimed, closed, closed_can, polled
from tests.recovery.foc.played import OneServo, servo
from tests.recovery.generator import GEAR_MOTOR, Scenario, Sensors, generate

MOTOR = Pmsm()
TRUTH = {"R": MOTOR.R, "K": MOTOR.K_phase, "J": MOTOR.J, "B": MOTOR.B}


def _motor(clock: Clock) -> FocMotor:
    return FocMotor(RunningFoc(FocDrive(MOTOR), clock))


def _check(
    driver: Driver, blocks: Iterable[SampleBlock], truth: Mapping[str, float], within: Mapping[str, float]
) -> None:
    """Exactly the parameters of `within` are claimed, each so near (a share of its truth) and within 4 of its std and
    3 %: what the std leaves out, as the project promises."""
    found = claimed(driver, blocks)
    assert set(found) == set(within)
    for name, share in within.items():
        value, std = found[name]
        error = abs(value - truth[name])
        assert error <= share * truth[name], (name, value / truth[name])
        assert error <= 4.0 * std + 0.03 * truth[name], (name, value / truth[name], std / truth[name])


def _monitor(decoder: Any, device: SimpleFocMonitor, clock: Clock, period_s: float, n: int) -> Iterator[SampleBlock]:
    decoder.feed(b"\n", 0.0)
    for k in range(n):
        clock.now_s = k * period_s
        block = decoder.feed(device.due(), clock.now_s)
        if block is not None:
            yield block


def test_simplefoc_tells_everything_but_the_inductance() -> None:
    clock, driver = Clock(), closed("simplefoc", period_s=2e-3, pole_pairs=7)
    device = SimpleFocMonitor(_motor(clock), period_s=2e-3)
    blocks = _monitor(driver._decoder, device, clock, 2e-3, 5000)
    _check(driver, blocks, TRUTH, {"R": 0.01, "K": 0.01, "J": 0.02, "B": 0.03})


def test_moteus_tells_the_mechanics_by_its_torque() -> None:
    clock, driver = Clock(), closed("moteus", pole_pairs=7)
    device = Fdcanusb(Moteus(_motor(clock), torque_constant=MOTOR.Kt))
    blocks = polled(driver, driver._query, device, clock, 1000.0, 12_000)
    _check(driver, blocks, TRUTH, {"J": 0.02, "B": 0.03})


@pytest.mark.first_is_fast
@pytest.mark.parametrize("kind", ["dynamixel", "feetech"])
def test_a_brushed_servo_tells_everything_but_the_inductance(kind: str) -> None:
    clock, driver = Clock(), closed(kind, rate_hz=500.0)
    driver._place.model = 1020
    motor = MovingMotor(SimulatedDrive(make_settings(rate_hz=1000.0, supply_V=12.0)), clock)
    device = DynamixelChain({1: motor}) if kind == "dynamixel" else FeetechChain({1: motor})
    blocks = polled(driver, OneServo(driver._family), device, clock, 500.0, 10_000)
    _check(driver, blocks, PAPER_MOTOR, {"R": 0.03, "K": 0.02, "J": 0.05, "B": 0.05})
    assert driver.meaning.voltage_scale_std == pytest.approx(0.1 / math.sqrt(12.0) / 12.0)


@pytest.mark.slow
def test_a_servo_that_is_read_nearly_as_often_as_it_steps_tells_the_mechanics() -> None:
    """Its current changes by a quarter of itself from one sample to the next, and nearly every step of it is seen."""
    sensors = Sensors(current_noise_A=0.003 * GEAR_MOTOR.rated_current_A, counts_per_rev=4096)
    recording = generate(GEAR_MOTOR, Scenario("multisine", 13.0, 1000, {}, sensors=sensors, seed=4_710))
    read = servo(GEAR_MOTOR, recording, 0.0, 500.0, 12.0, kind="dynamixel")
    truth = {name: getattr(GEAR_MOTOR, name) for name in ("R", "K", "J", "B")}
    _check(read.driver, read.blocks, truth, {"R": 0.03, "K": 0.02, "J": 0.05, "B": 0.05})


def _frames(decoder: Any, node: Any, clock: Clock, period_s: float, n: int) -> Iterator[SampleBlock]:
    """What a node sends by itself, a bunch of frames at a time, stamped when they were sent."""
    for start in range(0, n, 20):
        sent = []
        for k in range(start, start + 20):
            clock.now_s = k * period_s
            sent += [(f.frame_id, f.data) for f in node.due()]
        yield from decoder.feed(batch(sent, period_s=period_s, start_s=start * period_s))


def test_mit_tells_the_mechanics_by_its_torque() -> None:
    clock, driver = Clock(), closed_can("mit", model="AK80-9", period_s=2e-3)
    motor = FocMotor(RunningFoc(FocDrive(ACTUATOR, SLOW), clock))
    node = MitActuator(motor, torque_per_ampere=ACTUATOR.Kt)
    blocks = _frames(driver._frames, node, clock, 2e-3, 10_000)
    _check(driver, blocks, {"J": ACTUATOR.J, "B": ACTUATOR.B}, {"J": 0.02, "B": 0.05})


def test_cia402_tells_the_mechanics_by_its_torque() -> None:
    pdo = {"0x181": ["statusword", "position", "torque"]}
    clock = Clock()
    driver = closed_can("cia402", pdo=pdo, counts_per_rev=8192, rated_torque_Nm=0.5, period_s=2e-3)
    assert isinstance(driver, Cia402Driver)
    node = Cia402Node(_motor(clock), torque_per_ampere=MOTOR.Kt, rated_torque_Nm=0.5)
    inner: Any = driver._inner
    _check(driver, _frames(inner._frames, node, clock, 2e-3, 10_000), TRUTH, {"J": 0.02, "B": 0.03})
