"""Drives of other makers, simulated, through the daemon to its REST API; the configuration is what the docs show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from servo_daemon.sim_drive.makes.foc import Pmsm
from tests.system.harness import Program, daemon, wait_for, write_config

MOTOR = Pmsm()


def simulated(link: Path, *words: str) -> Program:
    """A simulated drive; its link is there."""
    program = Program("sim-drive", *words)
    wait_for(link.is_symlink, f"{link} appears")
    return program


def close(document: dict[str, Any], name: str, truth: float, relative: float) -> bool:
    value = document["parameters"][name]["value"]
    tracked = document["parameters"][name]["status"] == "tracking"
    return tracked and value is not None and abs(value / truth - 1.0) < relative


@pytest.mark.slow
def test_a_vesc_is_its_port_and_nothing_else(tmp_path: Path) -> None:
    """R and K of the motor, from averages of vq and iq; J and B are right where they are claimed, which a machine too
    busy to ask in time keeps them from being."""
    link = tmp_path / "vesc0"
    config = write_config(tmp_path / "c.toml", f'name = "axis1"\ndriver = "vesc"\n[drive.options]\nport = "{link}"')
    drive = simulated(link, "--vesc", str(link))
    try:
        with daemon("--config", config, "--state-dir", tmp_path / "state") as program:
            shown = program.until(lambda d: close(d, "K", MOTOR.K_phase, 0.02) and close(d, "R", MOTOR.R, 0.02), "R, K")
            for name, truth in {"J": MOTOR.J, "B": MOTOR.B}.items():
                value, std = (shown["parameters"][name][key] for key in ("value", "std"))
                assert value is None or abs(value - truth) < 4.0 * std + 0.03 * truth
            assert shown["health"]["polls_answered"] > 100
            (listed,) = program.get("/drives")["drives"]
            assert listed["driver"] == "vesc"
    finally:
        drive.end()


@pytest.mark.slow
def test_an_odrives_torque_gives_inertia_and_friction_and_no_resistance(tmp_path: Path) -> None:
    link = tmp_path / "can0"
    options = f'[drive.options]\ninterface = "slcan"\nchannel = "{link}"'
    config = write_config(tmp_path / "c.toml", f'name = "axis1"\ndriver = "odrive"\n{options}')
    drive = simulated(link, "--odrive", "0.6", str(link), "--drive-id", "5")
    try:
        with daemon("--config", config, "--state-dir", tmp_path / "state") as program:
            shown = program.until(lambda d: close(d, "J", MOTOR.J, 0.1), "J")
            assert shown["parameters"]["R"]["value"] is None
            assert "voltage" in shown["parameters"]["R"]["reason"]
    finally:
        drive.end()
