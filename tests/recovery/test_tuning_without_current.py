"""Gains from a capture without a current sensor, on the motor that made it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture
from servo_daemon.commands.tune.motor import known_motor
from servo_daemon.config import DriveConfig
from servo_daemon.tuning.assess import margins_of
from servo_daemon.tuning.knowledge import NEEDED, Ask, CascadeGains, LoopSetup
from servo_daemon.tuning.laws import controller
from servo_daemon.tuning.report import tune
from servo_daemon.tuning.response import bandwidth_hz
from servo_daemon.tuning.sampled import sampled_motor
from tests.recovery.generator import GEAR_MOTOR, PAPER, RE40, Motor, Scenario, generate

SETUP = LoopSetup(rate_hz=1000.0)


def blind(motor: Motor, path: Path, seed: int) -> Capture:
    """5 s of voltage and encoder."""
    r = generate(motor, Scenario("multisine", seconds=5.0, seed=seed))
    rows = np.column_stack([r.time_s, r.voltage_V, r.position_rad])
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header="time_s,voltage_V,position_rad", comments="")
    return read_capture(path)


@pytest.mark.parametrize(
    "motor",
    [RE40, pytest.param(PAPER, marks=pytest.mark.slow), pytest.param(GEAR_MOTOR, marks=pytest.mark.slow)],
    ids=lambda m: m.name,
)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_the_true_motor_has_the_promised_loop(motor: Motor, tmp_path: Path, seed: int) -> None:
    drive = DriveConfig(name="axis", driver="replay")
    known = known_motor(drive, blind(motor, tmp_path / "blind.csv", seed), {})
    truth = np.log([getattr(motor, name) for name in NEEDED])
    for design, _ in tune(known, SETUP, Ask()).designs:
        assert isinstance(design.gains, CascadeGains)
        assert design.worst is not None
        real = margins_of(design.gains, truth, SETUP)
        assert real.stable
        assert real.phase_margin_deg is not None
        assert design.worst.margins.phase_margin_deg is not None
        assert real.phase_margin_deg > design.worst.margins.phase_margin_deg
        assert real.sensitivity_peak is not None
        assert design.worst.margins.sensitivity_peak is not None
        assert real.sensitivity_peak < design.worst.margins.sensitivity_peak
        sampled = sampled_motor(truth[None, :], SETUP.period_s, SETUP.delay_samples)
        reached = bandwidth_hz(sampled, controller(design.gains, SETUP.period_s))
        assert reached == pytest.approx(design.response.bandwidth_hz, rel=0.05)
