"""Another program that reads a VESC's averages beside the driver, in lockstep: it is recognised, and only it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servo_daemon.samples import SampleBlock, concatenate
from servo_daemon.sim_drive.makes.foc import FocDrive, Motion, Pmsm, RunningFoc
from servo_daemon.sim_drive.makes.vesc import VescDevice
from tests.recovery.foc.lockstep import Clock, closed, polled
from tests.recovery.foc.played import SharedVesc

#: Its current is a tenth of the other's.
SMALL = Pmsm(R=0.4, L=2e-4, flux=0.003, J=2e-5, B=1e-4, Tc=1e-3, current_limit_A=4.0)
MOTIONS = {
    "sines": Motion(),
    "slow": Motion(((80.0, 0.11), (20.0, 0.37))),
    "rest": Motion(()),
    "steady": Motion(((60.0, 1e-4),)),
    "fast": Motion(((20.0, 7.3), (10.0, 11.1))),
}


def read(
    rate_hz: float, seconds: float, *, another_hz: float = 0.0, motion: str = "sines", motor: Pmsm | None = None
) -> tuple[Any, SampleBlock]:
    clock, driver = Clock(), closed("vesc", rate_hz=rate_hz, position="encoder")
    running = RunningFoc(FocDrive(motor, MOTIONS[motion], seed=1), clock)
    device = SharedVesc(running, clock, another_hz) if another_hz else VescDevice(running)
    blocks = polled(driver, driver._new_dialogue(), device, clock, rate_hz, round(rate_hz * seconds))
    return driver, concatenate(list(blocks))


@pytest.mark.parametrize("another_hz", [20.0, 40.0, 60.0])
@pytest.mark.parametrize(("rate_hz", "motor"), [(200.0, None), (200.0, SMALL), (50.0, None)])
def test_another_program_is_recognised_before_its_averages_are_believed(
    rate_hz: float, motor: Pmsm | None, another_hz: float
) -> None:
    driver, block = read(rate_hz, 6.0, another_hz=another_hz, motor=motor)
    assert "another program" in (driver.remark or "")
    assert np.isnan(block.voltage_V).all() and np.isnan(block.current_A).all()
    assert np.isfinite(block.position_rad).all()


def test_a_current_that_turns_as_fast_as_it_reads_shows_it_later() -> None:
    driver, _ = read(200.0, 15.0, another_hz=20.0, motion="fast")
    assert "another program" in (driver.remark or "")


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(("rate_hz", "motor"), [(200.0, None), (200.0, SMALL), (20.0, None)])
def test_without_one_the_averages_are_believed_after_some_seconds(
    rate_hz: float, motor: Pmsm | None, motion: str
) -> None:
    driver, block = read(rate_hz, 10.0, motion=motion, motor=motor)
    assert driver.counters.extra["averages_reset"] == 0 and driver.remark is None
    believed = np.flatnonzero(np.isfinite(block.voltage_V) & np.isfinite(block.current_A))
    assert believed[0] < 2.7 * rate_hz
    assert len(believed) == len(block) - believed[0]
