"""Drives of other makers, simulated, through the daemon to its REST API; the configuration is what the docs show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from servo_daemon.sim_drive.makes.catalogue import ACTUATOR
from servo_daemon.sim_drive.makes.foc import Pmsm
from servo_daemon.simulate.settings import PAPER_MOTOR
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


#: The configuration of each make as docs/drives.md shows it, and what its REST API tells: truth and how near.
MAKES: dict[str, tuple[str, dict[str, tuple[float, float]]]] = {
    "simplefoc": (
        'port = "{link}"\npole_pairs = 7',
        {"R": (MOTOR.R, 0.05), "K": (MOTOR.K_phase, 0.05), "J": (MOTOR.J, 0.1)},
    ),
    "moteus": ('port = "{link}"\npole_pairs = 7', {"J": (MOTOR.J, 0.1)}),
    "dynamixel": ('port = "{link}"\nrate_hz = 500.0', {"R": (PAPER_MOTOR["R"], 0.1), "K": (PAPER_MOTOR["K"], 0.1)}),
    # Steps of 6.5 mA at times that are known to half a millisecond: K is often open (docs/drives.md), and never wrong.
    "feetech": ('port = "{link}"\nrate_hz = 500.0', {}),
    "mit": (
        'interface = "slcan"\nchannel = "{link}"\nbitrate = 1_000_000\nmodel = "AK80-9"\nperiod_s = 2e-3',
        {"J": (ACTUATOR.J, 0.1)},
    ),
    "cia402": (
        'interface = "slcan"\nchannel = "{link}"\nbitrate = 1_000_000\nperiod_s = 2e-3\ncounts_per_rev = 8192\n'
        'rated_torque_Nm = 2.0\npdo = {{ "0x181" = ["statusword", "position", "torque"] }}',
        {"J": (MOTOR.J, 0.1)},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("make", MAKES)
def test_a_make_is_its_few_lines_of_configuration(make: str, tmp_path: Path) -> None:
    options, wanted = MAKES[make]
    link = tmp_path / "link"
    text = f'name = "axis1"\ndriver = "{make}"\n[drive.options]\n{options.format(link=link)}'
    config = write_config(tmp_path / "c.toml", text)
    words = [f"--{make}", str(link)]
    if make in ("dynamixel", "feetech"):
        words += ["--ageing", "R=+0%/1h"]
    drive = simulated(link, *words)
    try:
        with daemon("--config", config, "--state-dir", tmp_path / "state") as program:
            what = ", ".join(wanted)
            shown = program.until(
                lambda d: d["samples"] > 5000 and all(close(d, name, *near) for name, near in wanted.items()), what
            )
            assert shown["health"]["connection"] == "connected"
            for name in ("R", "K") if make == "feetech" else ():
                assert shown["parameters"][name]["status"] != "tracking" or close(shown, name, PAPER_MOTOR[name], 0.15)
    finally:
        drive.end()
