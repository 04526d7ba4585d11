"""`commission` through the real command and the real wire: what hides in the drive is named, and it ends at 0 V."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from drivers.base import DriveInfo
from drivers.serial.commander import CommandedSerialDriver
from servo_daemon.cli import main
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.sim_drive.source import Drive, Reversed
from servo_daemon.simulate import DEFAULT_J_M, SimulatedDrive, make_settings
from tests.commissioning_rig import write_config
from tests.drivers.serial_rig import serial_rig

#: V, A, rad/s, rad, s.
LIMITS = (24.0, 20.0, 60.0, 30.0, 40.0)


@dataclass
class Watched:
    """The motor of `sim-drive --commands`, and the most that it was seen to do."""

    drive: Drive
    voltage: list[float] = field(default_factory=list)
    peaks: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("current_A", "position_rad"), 0.0))

    @property
    def info(self) -> DriveInfo:
        return self.drive.info

    @property
    def most_V(self) -> float:
        return self.drive.most_V

    def next_block(self, n: int) -> SampleBlock:
        raise AssertionError("a commanded drive has no motion of its own")

    def commanded_block(self, voltage_V: F64) -> SampleBlock:
        block = self.drive.commanded_block(voltage_V)
        self.voltage += voltage_V.tolist()
        for name in self.peaks:
            self.peaks[name] = max(self.peaks[name], float(np.abs(getattr(block, name)).max()))
        return block


def simulated(*effects: str) -> SimulatedDrive:
    """The motor of `sim-drive --commands`."""
    return SimulatedDrive(make_settings(J_m=DEFAULT_J_M, effects=effects, ageing=[], rate_hz=1000.0, seed=0))


@pytest.mark.slow
def test_a_wrong_sign_of_the_simulated_drives_encoder_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CommandedSerialDriver, "hold_s", 5.0)  # the drive waits for the host: no silence is one
    drive = Watched(Reversed(simulated(), "position_rad"))
    config, out = write_config(tmp_path / "servo.toml", tmp_path / "servo", LIMITS), tmp_path / "out"
    with serial_rig(tmp_path / "servo", commanded=drive, realtime=False):
        assert main(["commission", "--config", str(config), "--drive", "axis1", "--out", str(out)]) == 1
    for told in (capsys.readouterr().out, (out / "commission.toml").read_text()):
        assert "the encoder has the wrong sign" in told
    assert drive.voltage[-1] == 0.0
    assert drive.peaks["current_A"] <= 1.01 * LIMITS[1] and drive.peaks["position_rad"] <= 1.01 * LIMITS[3]
