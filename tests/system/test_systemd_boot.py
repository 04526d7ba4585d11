"""The package under a real systemd: from the boot by way of crashes and an upgrade to a purge that leaves nothing."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from tests.system.machine import NEW, OLD_VERSION, OWN, SOURCE, UNIT, Machine, booted, packaged_root, wait_for

# The first run builds the container: debootstrap, the packages of the lock, the package.
pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(1200)]

CONFIG = f"/etc/{UNIT}/{UNIT}.toml"
STATE = f"/var/lib/{UNIT}/axis1.state.json"
PROGRAM = "/opt/servo-daemon/.venv/bin/servo-daemon"
SILENT_DRIVE = '[[drive]]\nname = "axis1"\ndriver = "serial"\n[drive.options]\nport = "/dev/servo/nobody"\n'


@pytest.fixture(scope="module")
def root(repo_root: Path, program: Callable[..., str], missing: Callable[[str], NoReturn]) -> Iterator[Path]:
    if os.geteuid() != 0:
        missing("root, which systemd-nspawn and debootstrap need")
    for name in ("systemd-nspawn", "debootstrap", "nsenter"):
        program(name)
    with packaged_root(repo_root) as root:
        yield root


@pytest.fixture(scope="module")
def machine(root: Path) -> Iterator[Machine]:
    with booted(root) as machine:
        # Before any test has started or stopped it.
        machine.at_boot = machine.show("ActiveState", "NRestarts", "UnitFileState") | {"drive": served(machine)}
        yield machine


def served(machine: Machine) -> str:
    """The drive whose estimates are served, once its parameters are known; nothing before that."""

    def known() -> str:
        document = machine.get("/api/v1/drives/axis1/estimates")
        return document["drive"] if {p["status"] for p in document["parameters"].values()} == {"tracking"} else ""

    return wait_for("estimates", known)


@pytest.fixture
def unit(machine: Machine) -> Machine:
    """The machine with the unit stopped, the example configuration and nothing learned."""
    machine.run("systemctl", "stop", UNIT)
    machine.run("systemctl", "reset-failed", UNIT, check=False)
    machine.run("rm", "-rf", f"/var/lib/private/{UNIT}", f"/var/lib/{UNIT}")
    machine.run("cp", "/opt/servo-daemon/share/example.toml", CONFIG)
    machine.forget_journal()
    return machine


def start_and_learn(unit: Machine) -> None:
    """Start, and wait until the drive is connected and its state has been saved."""
    unit.run("systemctl", "start", UNIT)
    wait_for("status line", lambda: unit.show("StatusText")["StatusText"].startswith("axis1 connected"))
    wait_for("state file", lambda: unit.run("ls", STATE, check=False))


def past(unit: Machine) -> dict[str, list[str]]:
    """Moments of the kept rows of R, and of the events."""
    rows = unit.get("/api/v1/drives/axis1/history?parameter=R&window=1h&level=rows&points=20000")["time"]
    return {"rows": rows, "events": [event["time"] for event in unit.get("/api/v1/drives/axis1/events")["events"]]}


def written_past(unit: Machine) -> dict[str, list[str]]:
    """What of the past is on the disk for certain: all but the last five seconds' rows (docs/operations.md)."""
    wait_for("six seconds of rows", lambda: len(past(unit)["rows"]) > 60)
    found = past(unit)
    return {"rows": found["rows"][:-50], "events": found["events"][:1]}


def assert_goes_on(unit: Machine, before: dict[str, list[str]]) -> None:
    """Estimates come, they began with the saved state, and the past is there."""
    assert served(unit)
    assert "saved state" in unit.journal()
    after = past(unit)
    for kind, moments in before.items():
        lost = set(moments) - set(after[kind])
        assert moments and not lost, (kind, lost, after[kind])


def test_it_starts_at_boot_and_serves_estimates(machine: Machine) -> None:
    assert machine.at_boot == {"ActiveState": "active", "NRestarts": "0", "UnitFileState": "enabled", "drive": "axis1"}


def test_it_runs_with_the_first_samples_and_keeps_what_it_learns(unit: Machine) -> None:
    start_and_learn(unit)
    assert unit.is_(ActiveState="active", SubState="running", NRestarts="0")
    document = unit.get("/api/v1/drives/axis1/estimates")
    assert document["drive"] == "axis1"
    assert document["samples"] > 0
    owner = unit.run("stat", "--format=%U", STATE).strip()
    assert owner == UNIT
    found = ("SERVO_EVENT=connected", "SERVO_DRIVE=axis1", "PRIORITY=6", f"_SYSTEMD_UNIT={UNIT}.service")
    assert "drive axis1: device opened" in unit.run("journalctl", "--no-pager", "--output=cat", *found)


def test_the_sandbox_lets_it_compile_and_load_the_plant(unit: Machine) -> None:
    start_and_learn(unit)
    assert unit.run("find", f"/var/cache/private/{UNIT}", "-name", "*.so")
    loaded = unit.run("cat", f"/proc/{unit.show('MainPID')['MainPID']}/maps")
    assert f"/{UNIT}/" in loaded
    assert "virtual machine" not in unit.journal()


def test_a_missing_port_delays_the_start_and_does_not_stop_it(unit: Machine) -> None:
    unit.write(CONFIG, SILENT_DRIVE)
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
    before = written_past(unit)
    hung = unit.show("MainPID")["MainPID"]
    unit.run("systemctl", "kill", "--signal=STOP", UNIT)
    wait_for("another process", lambda: unit.show("MainPID")["MainPID"] not in {hung, "0"})
    wait_for("READY", lambda: unit.is_(ActiveState="active", NRestarts="1"))
    assert "Watchdog timeout" in unit.journal()
    assert_goes_on(unit, before)


def test_a_crash_loses_nothing_that_was_saved(unit: Machine) -> None:
    start_and_learn(unit)
    before = written_past(unit)
    unit.run("systemctl", "kill", "--signal=KILL", UNIT)
    wait_for("a restart", lambda: unit.is_(ActiveState="active", NRestarts="1"))
    assert_goes_on(unit, before)


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
    unit.write(CONFIG, "[api]\nprot = 8077\n")
    unit.run("systemctl", "start", UNIT, check=False)
    assert unit.is_(ActiveState="failed", SubState="failed", ExecMainStatus="2", NRestarts="0")
    assert unit.journal().count("unknown key 'api.prot'") == 1


def test_a_reload_reads_conf_d_and_a_wrong_file_changes_nothing(unit: Machine) -> None:
    config = unit.run("sh", "-c", f"systemctl cat {UNIT} | sed -n 's/^ExecStart=.*--config //p'").strip()
    drop_in = str(Path(config).parent / "conf.d" / "test.toml")
    start_and_learn(unit)
    process = unit.show("MainPID")
    try:
        unit.run("mkdir", "-p", str(Path(drop_in).parent))
        unit.write(drop_in, '[[drive]]\nname = "axis2"\n')
        unit.run("systemctl", "reload", UNIT)
        wait_for("the new drive", lambda: "axis2" in unit.show("StatusText")["StatusText"])
        wait_for("READY again", lambda: unit.is_(ActiveState="active", SubState="running"))
        unit.write(drop_in, "[api]\nprot = 1\n")
        unit.run("systemctl", "reload", UNIT)
        wait_for("the refusal", lambda: f"{drop_in}: unknown key 'api.prot', line 2" in unit.journal())
        wait_for("READY again", lambda: unit.is_(ActiveState="active", SubState="running", NRestarts="0"))
        assert "axis2" in unit.show("StatusText")["StatusText"] and unit.show("MainPID") == process
    finally:
        unit.run("rm", "-f", drop_in)


def test_tokens_come_as_a_credential_that_only_the_service_can_read(unit: Machine) -> None:
    tokens, folder = "/etc/tokens-of-root", f"/etc/systemd/system/{UNIT}.service.d"
    secret = unit.run(f"{PROGRAM}", "token", "new", "me", "--file", tokens).strip()
    unit.run("chmod", "600", tokens)
    unit.run("mkdir", "-p", folder)
    unit.write(f"{folder}/tokens.conf", f"[Service]\nLoadCredential=servo-daemon.tokens:{tokens}\n")
    try:
        unit.run("systemctl", "daemon-reload")
        unit.run("systemctl", "start", UNIT)
        ask = "import sys, urllib.request as r; r.urlopen(r.Request(sys.argv[1], headers={sys.argv[2]: sys.argv[3]}))"
        address = "http://127.0.0.1:8077/api/v1/health"
        unit.run("python3", "-c", ask, address, "Authorization", f"Bearer {secret}")
        assert "HTTP Error 401" in unit.run("sh", "-c", f"python3 -c '{ask}' {address} A B 2>&1", check=False)
    finally:
        unit.run("rm", "-rf", folder, tokens)
        unit.run("systemctl", "daemon-reload")


def test_a_token_made_by_root_is_read_by_the_service_and_by_nobody_else(unit: Machine) -> None:
    tokens = f"/etc/{UNIT}/tokens"
    token = unit.run(UNIT, "token", "new", "grafana", "--scope", "read", "--file", tokens).strip()
    assert unit.run("stat", "--format=%U:%G %a", tokens).strip() == f"root:{UNIT} 640"
    unit.run("sed", "-i", f's|^# tokens_file = .*|tokens_file = "{tokens}"|', CONFIG)
    start_and_learn(unit)
    assert "drives" in unit.get("/api/v1/drives", token)
    assert unit.get("/api/v1/drives")["status"] == 401
    unit.run("rm", tokens)


def test_lintian_finds_nothing_wrong(root: Path, program: Callable[..., str]) -> None:
    package = root / OWN.lstrip("/")
    command = [program("lintian"), "--allow-root", "--fail-on=error,warning", str(package)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_manual_pages_and_completion_are_there(machine: Machine) -> None:
    pages = machine.run("ls", "/usr/share/man/man1", "/usr/share/man/man5").split()
    assert {"servo-daemon.1.gz", "servo-daemon-fit.1.gz", "servo-daemon.toml.5.gz"} <= set(pages)
    completion = f". /usr/share/bash-completion/completions/{UNIT}; complete -p {UNIT}"
    assert UNIT in machine.run("bash", "-c", completion)


def test_udev_understands_the_rules(machine: Machine) -> None:
    def complaints() -> list[str]:
        done = machine.run("sh", "-c", "udevadm test --action=add /sys/class/mem/null 2>&1", check=False)
        assert "Reading rules file: /usr/lib/udev/rules.d/99-servo-daemon.rules" in done
        return [line for line in done.splitlines() if "99-servo-daemon.rules:" in line]

    assert complaints() == []
    rules = machine.run("cat", "/usr/lib/udev/rules.d/99-servo-daemon.rules")
    machine.write("/usr/lib/udev/rules.d/99-servo-daemon.rules", rules + 'SYMLIKN+="x"\n')
    assert complaints() != []
    machine.write("/usr/lib/udev/rules.d/99-servo-daemon.rules", rules)


def leftovers(machine: Machine) -> list[str]:
    """Whatever is named after the program, but for its source tree; and its user."""
    found = machine.run(
        "find", "/", "(", "-path", "/proc", "-o", "-path", "/sys", "-o", "-path", "/usr/src", ")", "-prune",
        "-o", "-name", "*servo*", "-print",
    )  # fmt: skip
    return found.split() + machine.run("getent", "passwd", UNIT, check=False).split()


def test_upgrade_keeps_purge_leaves_nothing_install_starts(unit: Machine) -> None:
    """Afterwards the newer package is installed, and runs as the older one did for the tests before this."""
    unit.write(f"/etc/{UNIT}/conf.d/own.toml", "")
    unit.run("sed", "-i", "s/^save_interval_s = .*/save_interval_s = 4.0/", CONFIG)
    start_and_learn(unit)
    assert unit.run("dpkg-query", "--show", "--showformat=${Version}", UNIT) in {OLD_VERSION, version(unit)}
    before, process = written_past(unit), unit.show("MainPID")
    unit.forget_journal()
    unit.run("dpkg", "--install", "--force-unsafe-io", NEW)
    assert unit.run("dpkg-query", "--show", "--showformat=${Version}", UNIT) == version(unit)
    assert unit.show("MainPID") != process
    assert_goes_on(unit, before)
    assert "save_interval_s = 4.0" in unit.run("cat", CONFIG)
    assert unit.run("ls", f"/etc/{UNIT}/conf.d") == "own.toml\n"

    unit.run("dpkg", "--purge", UNIT)
    assert leftovers(unit) == []
    assert unit.show("LoadState") == {"LoadState": "not-found"}
    install_from_source_and_remove(unit)

    unit.run("dpkg", "--install", "--force-unsafe-io", NEW)
    assert unit.is_(ActiveState="active", UnitFileState="enabled")
    assert served(unit)


def install_from_source_and_remove(machine: Machine) -> None:
    """`make install` where no package is; then what docs/operations.md says of removing it."""
    machine.run("mkdir", f"/opt/{UNIT}")
    machine.run("ln", "-s", f"{SOURCE}/build/deb/venv", f"/opt/{UNIT}/.venv")  # has the packages of the lock already
    machine.write(f"/etc/{UNIT}.toml", SILENT_DRIVE)  # where the configuration was before there was a package
    machine.run("make", "-C", SOURCE, "install")
    assert machine.run("cat", CONFIG) == SILENT_DRIVE
    machine.run("cp", f"/opt/{UNIT}/share/example.toml", CONFIG)
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "enable", "--now", UNIT)
    assert served(machine)
    machine.run("systemctl", "disable", "--now", UNIT)
    places = ("lib", "lib/private", "cache", "cache/private")
    folders = [f"/opt/{UNIT}", f"/etc/{UNIT}", *(f"/var/{place}/{UNIT}" for place in places)]
    files = ["systemd/system/{}.service", "sysusers.d/{}.conf", "tmpfiles.d/{}.conf", "udev/rules.d/99-{}.rules"]
    machine.run("rm", "-r", *folders, *(f"/etc/{name.format(UNIT)}" for name in files))
    machine.run("userdel", UNIT)
    assert leftovers(machine) == []


def version(machine: Machine) -> str:
    return machine.run("dpkg-deb", "--field", NEW, "Version").strip()
