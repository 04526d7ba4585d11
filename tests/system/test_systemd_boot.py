"""The unit under a real systemd: start, status, watchdog, crash, stop, and a configuration that is wrong."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from tests.system.machine import UNIT, Machine, booted, installed_root, wait_for

# The first run builds the container: debootstrap and the packages of the lock.
pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(1200)]

STATE = f"/var/lib/{UNIT}/axis1.state.json"
SILENT_DRIVE = '[[drive]]\nname = "axis1"\ndriver = "serial"\n[drive.options]\nport = "/dev/servo/nobody"\n'


@pytest.fixture(scope="module")
def machine(repo_root: Path, program: Callable[..., str], missing: Callable[[str], NoReturn]) -> Iterator[Machine]:
    if os.geteuid() != 0:
        missing("root, which systemd-nspawn and debootstrap need")
    for name in ("systemd-nspawn", "debootstrap", "nsenter"):
        program(name)
    with installed_root(repo_root) as root, booted(root) as machine:
        yield machine


@pytest.fixture
def unit(machine: Machine) -> Machine:
    """The machine with the unit stopped, the example configuration and nothing learned."""
    machine.run("systemctl", "stop", UNIT)
    machine.run("systemctl", "reset-failed", UNIT, check=False)
    machine.run("rm", "-rf", f"/var/lib/private/{UNIT}", f"/var/lib/{UNIT}")
    machine.run("cp", "/opt/servo-daemon/share/example.toml", "/etc/servo-daemon.toml")
    machine.forget_journal()
    return machine


def start_and_learn(unit: Machine) -> None:
    """Start, and wait until the drive is connected and its state has been saved."""
    unit.run("systemctl", "start", UNIT)
    wait_for("status line", lambda: unit.show("StatusText")["StatusText"].startswith("axis1 connected"))
    wait_for("state file", lambda: unit.run("ls", STATE, check=False))


def test_it_runs_with_the_first_samples_and_keeps_what_it_learns(unit: Machine) -> None:
    start_and_learn(unit)
    assert unit.is_(ActiveState="active", SubState="running", NRestarts="0")
    document = unit.get("/api/v1/drives/axis1/estimates")
    assert document["drive"] == "axis1"
    assert document["samples"] > 0
    owner = unit.run("stat", "--format=%U", STATE).strip()
    assert owner not in {"root", "nobody"}
    found = ("SERVO_EVENT=connected", "SERVO_DRIVE=axis1", "PRIORITY=6", f"_SYSTEMD_UNIT={UNIT}.service")
    assert "drive axis1: device opened" in unit.run("journalctl", "--no-pager", "--output=cat", *found)


def test_the_sandbox_lets_it_compile_and_load_the_plant(unit: Machine) -> None:
    start_and_learn(unit)
    assert unit.run("find", f"/var/cache/private/{UNIT}", "-name", "*.so")
    loaded = unit.run("cat", f"/proc/{unit.show('MainPID')['MainPID']}/maps")
    assert f"/{UNIT}/" in loaded
    assert "virtual machine" not in unit.journal()


def test_a_missing_port_delays_the_start_and_does_not_stop_it(unit: Machine) -> None:
    unit.write("/etc/servo-daemon.toml", SILENT_DRIVE)
    unit.run("systemctl", "start", "--no-block", UNIT)
    wait_for("the process", lambda: unit.show("MainPID")["MainPID"] != "0")
    wait_for("READY", lambda: unit.is_(ActiveState="active", SubState="running"))
    times = unit.show("ExecMainStartTimestampMonotonic", "ActiveEnterTimestampMonotonic")
    waited_us = int(times["ActiveEnterTimestampMonotonic"]) - int(times["ExecMainStartTimestampMonotonic"])
    assert waited_us > 5e6  # it waited for samples before it said READY
    assert not unit.show("StatusText")["StatusText"].startswith("axis1 connected")
    assert "/dev/servo/nobody" in unit.journal()
    assert [drive["name"] for drive in unit.get("/api/v1/drives")["drives"]] == ["axis1"]


def test_a_hung_daemon_is_started_again_by_the_watchdog(unit: Machine) -> None:
    start_and_learn(unit)
    hung = unit.show("MainPID")["MainPID"]
    unit.run("systemctl", "kill", "--signal=STOP", UNIT)
    wait_for("another process", lambda: unit.show("MainPID")["MainPID"] not in {hung, "0"})
    wait_for("READY", lambda: unit.is_(ActiveState="active", NRestarts="1"))
    assert "Watchdog timeout" in unit.journal()


def test_a_crash_loses_nothing_that_was_saved(unit: Machine) -> None:
    start_and_learn(unit)
    unit.run("systemctl", "kill", "--signal=KILL", UNIT)
    wait_for("a restart", lambda: unit.is_(ActiveState="active", NRestarts="1"))
    wait_for("the saved state", lambda: "saved state" in unit.journal())


def test_a_stop_is_clean_and_takes_less_than_two_seconds(unit: Machine) -> None:
    start_and_learn(unit)
    unit.run("rm", STATE)
    unit.run("systemctl", "stop", UNIT)
    assert unit.is_(ActiveState="inactive", Result="success", ExecMainStatus="0")
    times = unit.show("ActiveExitTimestampMonotonic", "InactiveEnterTimestampMonotonic")
    took_us = int(times["InactiveEnterTimestampMonotonic"]) - int(times["ActiveExitTimestampMonotonic"])
    assert took_us < 2e6
    unit.run("test", "-s", STATE)  # saved once more on the way


def test_a_wrong_configuration_is_said_once_and_not_tried_again(unit: Machine) -> None:
    unit.write("/etc/servo-daemon.toml", "[api]\nprot = 8077\n")
    unit.run("systemctl", "start", UNIT, check=False)
    assert unit.is_(ActiveState="failed", SubState="failed", ExecMainStatus="2", NRestarts="0")
    assert unit.journal().count("unknown key 'api.prot'") == 1


def test_udev_understands_the_rules(machine: Machine) -> None:
    def complaints() -> list[str]:
        done = machine.run("sh", "-c", "udevadm test --action=add /sys/class/mem/null 2>&1", check=False)
        assert "Reading rules file: /etc/udev/rules.d/99-servo-daemon.rules" in done
        return [line for line in done.splitlines() if "99-servo-daemon.rules:" in line]

    assert complaints() == []
    rules = machine.run("cat", "/etc/udev/rules.d/99-servo-daemon.rules")
    machine.write("/etc/udev/rules.d/99-servo-daemon.rules", rules + 'SYMLIKN+="x"\n')
    assert complaints() != []
    machine.write("/etc/udev/rules.d/99-servo-daemon.rules", rules)
