"""Nothing moves a motor without permission, and only few drives can be commanded."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.commanding import COMMANDING, LONGEST_COMMAND_S, make_commanding
from drivers.registry import BUILT_IN, driver_class
from servo_daemon.cli import main
from servo_daemon.commands.commission import command
from servo_daemon.commands.commission.command import parse_accuracy
from servo_daemon.config import parse_config
from servo_daemon.errors import BadInputError, ConfigError, DriverConfigError, DriverError
from servo_daemon.simulate import driver as simulated_driver
from servo_daemon.simulate.driver import SimulatedDriver
from tests.commanded_motor import HEALTHY, CommandedMotor
from tests.commissioning_rig import write_config

ALLOWED = """
[[drive]]
name = "axis1"
driver = "simulated"
options = { realtime = false, seed = 3 }
[drive.commission]
allow_motion = true
voltage_V = 24.0
current_A = 20.0
speed_rad_s = 20.0
travel_rad = 6.0
"""


def test_the_drivers_that_can_command_are_these() -> None:
    """Whoever gives another driver `command` has to write it down here, with its dead man."""
    able = {kind for kind in BUILT_IN if hasattr(driver_class(kind), "command")}
    assert able == {"simulated"}  # of what `run` uses: a motor of this very process
    assert set(COMMANDING) == {"simulated", "serial"}  # of what `commission` uses
    assert make_commanding("can", "axis1", {}) is None
    with pytest.raises(DriverConfigError, match="unknown driver 'seriall'"):
        make_commanding("seriall", "axis1", {})


def test_a_simulated_drive_stops_by_itself() -> None:
    driver = SimulatedDriver("axis1", {"realtime": False})
    with pytest.raises(DriverError, match="before open"):
        driver.command(1.0, 0.01)
    with driver:
        driver.command(5.0, 10.0)  # longer than any command is valid
        blocks = [b for _ in range(80) if (b := driver.read(0.0)) is not None]
        voltage = np.concatenate([b.voltage_V for b in blocks if b.voltage_V is not None])
        held = round(LONGEST_COMMAND_S * 1000)
        assert np.allclose(voltage[:held], 5.0, atol=0.01)
        assert not voltage[held:].any()
        assert all(len(b) == 1 for b in blocks)
        with pytest.raises(DriverError, match="no command"):
            driver.command(float("nan"), 0.01)


def test_a_commanded_simulated_drive_stands_still_while_its_process_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(simulated_driver, "time", SimpleNamespace(monotonic=lambda: now))
    with SimulatedDriver("axis1", {}) as driver:
        lengths = []
        for late_s in (0.0011, 0.008, 0.5, 0.0011):
            driver.command(0.0, 0.02)
            now += late_s
            block = driver.read(0.0)
            assert block is not None and not np.isnan(driver.acting_V(block)).any()
            lengths.append(len(block))
    assert lengths == [1, 8, 1, 1]


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (ALLOWED.replace("allow_motion = true", ""), "needs allow_motion = true"),
        (
            ALLOWED.replace('"simulated"', '"vesc"').replace("realtime = false, seed = 3", 'port = "/dev/x"'),
            "only reads",
        ),
    ],
    ids=["not allowed", "cannot"],
)
def test_without_permission_or_ability_it_is_refused(
    config: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "servo.toml"
    path.write_text(config)
    assert main(["commission", "--config", str(path)]) == 1
    assert said in capsys.readouterr().err


def test_motion_needs_its_limits() -> None:
    drive = {"name": "axis1", "commission": {"allow_motion": True, "voltage_V": 12.0}}
    with pytest.raises(ConfigError, match="needs the limits current_A, speed_rad_s, travel_rad"):
        parse_config({"drive": [drive]})


def test_accuracy_is_a_share() -> None:
    assert parse_accuracy("0.5%") == pytest.approx(0.005)
    for text in ("0.01", "0%", "60%", "1e3%"):
        with pytest.raises(BadInputError, match="--accuracy"):
            parse_accuracy(text)


class Plugged(CommandedMotor):
    """A motor that the command opens."""

    def __enter__(self) -> Plugged:
        return self

    def __exit__(self, *_: object) -> None:
        """It stays."""


@pytest.mark.slow
def test_the_command_names_hidden_friction_and_writes_what_it_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    setup, limits = HEALTHY["small"]
    motor = Plugged(replace(setup, Tc=0.01))
    monkeypatch.setattr(command, "commanding_driver", lambda _drive: (motor, motor))
    config, out = write_config(tmp_path / "c.toml", tmp_path / "x", (12.0, 6.0, 150.0, 30.0, 60.0)), tmp_path / "out"
    assert main(["commission", "--config", str(config), "--out", str(out), "--budget", "8"]) == 0
    document = json.loads((out / "commission.json").read_text())
    assert (document["outcome"], document["model"]) == ("known", ["coulomb_friction"])
    assert document["parameters"]["Tc"]["value"] == pytest.approx(0.01, rel=0.02)
    for told in (capsys.readouterr().out, (out / "commission.toml").read_text()):
        assert "found: coulomb_friction: Dry friction" in told
    assert motor.share_of(limits) <= 1.01
    names = {p.name for p in out.iterdir()}
    assert document["tuning"] is not None
    assert {"capture.csv.gz", "commission.json", "commission.toml", "tuning.json", "controller.toml"} <= names
    # The lines are configuration.
    written = tmp_path / "next.toml"
    written.write_text('[[drive]]\nname = "axis1"\n' + (out / "commission.toml").read_text())
    assert main(["commission", "--config", str(written)]) == 1
    assert "needs allow_motion" in capsys.readouterr().err
