"""Commissioning over the real serial wire, on a pseudo-terminal: whatever happens the motor stops."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.commanding import make_commanding
from drivers.serial.command import decode_command
from drivers.serial.commander import CommandedSerialDriver
from drivers.serial.frame import decode_frame
from drivers.serial.line import SerialDriver
from servo_daemon.cli import main
from servo_daemon.commissioning import Commissioning, commission
from servo_daemon.errors import DriverConfigError, DriverError
from servo_daemon.sim_drive.transmitter import Transmitter
from tests.commanded_motor import HEALTHY, CommandedMotor
from tests.commissioning_rig import Wired, write_config
from tests.drivers.serial_rig import Rig, serial_rig, wait_for

SETUP, LIMITS = HEALTHY["small"]


@contextlib.contextmanager
def drive(link: Path, source: Wired, *, realtime: bool = False) -> Iterator[Rig]:
    with serial_rig(link, commanded=source, realtime=realtime) as rig:
        yield rig


def commissioned(link: Path) -> Commissioning:
    driver = CommandedSerialDriver("axis1", {"port": str(link)})
    with driver:
        return commission(driver, LIMITS)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The drives of most tests wait for the host: then no silence is one."""
    monkeypatch.setattr(CommandedSerialDriver, "hold_s", 5.0)


@pytest.mark.slow
def test_a_motor_is_known_over_the_wire_and_nothing_but_commands_is_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[bytes] = []
    take = Transmitter.take_heard

    def recorded(line: Transmitter) -> bytes:
        sent.append(take(line))
        return sent[-1]

    monkeypatch.setattr(Transmitter, "take_heard", recorded)
    source = Wired(CommandedMotor(SETUP))
    with drive(tmp_path / "servo", source):
        result = commissioned(tmp_path / "servo")
    assert result.outcome == "known" and result.fit is not None
    for name, value in result.fit.values.items():
        assert abs(value / getattr(SETUP, name) - 1.0) < 0.01, name
    assert source.motor.share_of(LIMITS) <= 0.8
    *frames, rest = b"".join(sent).split(b"\0")
    commands = [decode_command(decode_frame(f)) for f in frames]
    assert not rest and len(commands) > 1000
    assert {c.drive_id for c in commands} == {1}
    assert commands[-1].voltage_V == 0.0  # the port is closed on a motor that is off
    assert max(c.valid_ms for c in commands) <= 50


def test_the_command_names_a_wrong_sign(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = Wired(CommandedMotor(replace(SETUP, encoder_sign=-1.0)))
    limits = (LIMITS.voltage_V, LIMITS.current_A, LIMITS.speed_rad_s, LIMITS.travel_rad, LIMITS.seconds)
    config, out = write_config(tmp_path / "servo.toml", tmp_path / "servo", limits), tmp_path / "out"
    with drive(tmp_path / "servo", source):
        assert main(["commission", "--config", str(config), "--out", str(out)]) == 1
    assert json.loads((out / "commission.json").read_text())["stop"]["reason"] == "encoder_sign"
    for told in (capsys.readouterr().out, (out / "commission.toml").read_text()):
        assert "the encoder has the wrong sign" in told
    assert source.motor.share_of(LIMITS) <= 1.01
    assert source.voltages[-1] == 0.0


def test_a_lost_port_is_a_stop(tmp_path: Path) -> None:
    source = Wired(CommandedMotor(SETUP))
    with drive(tmp_path / "servo", source) as rig:
        source.each = lambda taken: rig.stop.set() if taken > 1500 else None
        result = commissioned(tmp_path / "servo")
    assert any(source.voltages)
    assert result.stop is not None and result.stop.reason == "port_lost"


def test_without_commands_nothing_is_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By what `run` uses to any drive, by commissioning to a drive that follows none."""
    lines: list[Transmitter] = []
    begin = Transmitter.__init__

    def noted(line: Transmitter, master: int) -> None:
        begin(line, master)
        lines.append(line)

    monkeypatch.setattr(Transmitter, "__init__", noted)
    with serial_rig(tmp_path / "servo", realtime=False):
        with SerialDriver("axis1", {"port": str(tmp_path / "servo")}) as driver:
            wait_for(lambda: driver.read(0.1) is not None, "samples")
        with pytest.raises(DriverError, match="takes no commands"):
            commissioned(tmp_path / "servo")
    assert [line.take_heard() for line in lines] == [b""]


def test_only_commissioning_can_send() -> None:
    assert not hasattr(SerialDriver, "command")
    made = make_commanding("serial", "axis1", {"port": "/dev/null"})
    assert made is not None and isinstance(made[0], CommandedSerialDriver)
    with pytest.raises(DriverConfigError, match="carries no commands"):
        make_commanding("serial", "axis1", {"port": "/dev/null", "wire": "text", "counts_per_rev": 4096.0})


def in_motion(process: subprocess.Popen[str], source: Wired) -> bool:
    """Waits until this process moves the motor; false: it has ended before."""
    before = np.count_nonzero(source.voltages)
    wait_for(lambda: np.count_nonzero(source.voltages) > before + 200 or process.poll() is not None, "motion")
    return process.poll() is None


def held(pid: int, source: Wired) -> int:
    """Stops this process for 300 samples of the drive; at which sample it stood."""
    os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: ") T " in Path(f"/proc/{pid}/stat").read_text(encoding="utf-8"), "it is stopped")
    stopped = len(source.voltages)
    wait_for(lambda: len(source.voltages) > stopped + 300, "the drive goes on")
    os.kill(pid, signal.SIGCONT)
    return stopped


@pytest.mark.slow
def test_the_drive_stops_by_itself_when_the_process_is_stopped(tmp_path: Path) -> None:
    """SIGSTOP in the middle of a motion, in real time."""
    source = Wired(CommandedMotor(SETUP))
    limits = (LIMITS.voltage_V, LIMITS.current_A, LIMITS.speed_rad_s, LIMITS.travel_rad, 20.0)
    config = write_config(tmp_path / "servo.toml", tmp_path / "servo", limits)
    command = [sys.executable, "-m", "servo_daemon", "commission", "--config", str(config), "--budget", "0", "--json"]
    with drive(tmp_path / "servo", source, realtime=True):
        for _ in range(10):  # on a busy machine silence ends a run, as it should, before it has begun
            with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
                try:
                    if not in_motion(process, source):
                        continue
                    stopped = held(process.pid, source)
                    out, err = process.communicate(timeout=60)
                    break
                finally:
                    process.kill()
        else:
            pytest.fail("no run came so far that the motor moved")
    assert any(source.voltages[stopped - 40 : stopped])
    # A block of two samples is being taken when the last command comes; it acts for 50 ms; and one sample.
    assert not any(source.voltages[stopped + 2 + 50 + 1 :])
    assert process.returncode == 1, err
    assert '"reason": "command_lost"' in out or '"reason": "data_missing"' in out, out
