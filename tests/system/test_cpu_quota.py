"""A daemon that gets less of the processor than it wants (systemd's CPUQuota=): it keeps its drive's samples and says
that it is behind."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from benchmarks.soak.drives import RATE_HZ, Drives, drives
from tests.system.harness import PATIENCE_S, DaemonProgram, daemon, nominal_table, wait_for, write_config

_ROOT = Path("/sys/fs/cgroup")
#: In which a quota is used up, µs: half a core in short turns, hardly any in the longest there are, since a turn has a
#: thousandth of a second at least.
_SHORT_US, _LONG_US = 100_000, 1_000_000
_LEAST_US = 1_000


@contextlib.contextmanager
def quota(missing: Callable[[str], NoReturn]) -> Iterator[tuple[Callable[[int], object], Callable[[float], object]]]:
    """Functions: take a process in; allow it a share of a core. Control groups of either version."""
    one = (_ROOT / "cpu").is_dir()
    group = (_ROOT / "cpu" if one else _ROOT) / f"servo-daemon-test-{time.monotonic_ns()}"
    name = "cpu.cfs_quota_us" if one else "cpu.max"
    try:
        if not one:
            (_ROOT / "cgroup.subtree_control").write_text("+cpu")
        group.mkdir()
        (group / name).write_text("-1" if one else f"max {_SHORT_US}")
    except OSError as error:
        with contextlib.suppress(OSError):
            group.rmdir()
        missing(f"a control group for the processor: {error}")

    def allow(share: float) -> None:
        period_us = _SHORT_US if share * _SHORT_US >= _LEAST_US else _LONG_US
        us = max(round(share * period_us), _LEAST_US)
        if one:  # without a quota, for a moment: a period is refused that makes more of it than there was
            (group / name).write_text("-1")
            (group / "cpu.cfs_period_us").write_text(str(period_us))
        (group / name).write_text(str(us) if one else f"{us} {period_us}")

    try:
        yield lambda pid: (group / "cgroup.procs").write_text(str(pid)), allow
    finally:
        wait_for(lambda: not (group / "cgroup.procs").read_text(), "the group is empty")
        group.rmdir()


def short(program: DaemonProgram, feeder: Drives) -> int:
    """How many samples that were sent whole the daemon has not used once it has worked off what it has."""
    feeder.tell("pause")
    (count,) = feeder.tell("count")
    assert count["no_room"] == 0, "the terminal held all of them"
    end = time.monotonic() + PATIENCE_S
    while (found := int(count["sent"]) - program.estimates()["samples"]) > 0 and time.monotonic() < end:
        time.sleep(0.05)
    feeder.tell("go")
    return found


def used_s(program: DaemonProgram) -> float:
    """Processor time so far."""
    fields = Path(f"/proc/{program.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def wanted_share(program: DaemonProgram) -> float:
    """Of a core, of this machine: what the daemon uses while it works off so many samples as they come."""
    before_s, before = used_s(program), program.estimates()["samples"]
    end = before + 4 * RATE_HZ
    after = program.until(lambda d: d["samples"] >= end, "four seconds more", every_s=1.0)["samples"]
    return (used_s(program) - before_s) * RATE_HZ / (after - before)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_starved_daemon_keeps_its_samples_and_says_so(missing: Callable[[str], NoReturn], tmp_path: Path) -> None:
    """Half a core is plenty for one drive. With a part of what it uses (many samples at once cost less each) it cannot
    keep up, and the port's own memory may run over; what it has read is used nevertheless."""
    with quota(missing) as (take, allow), drives(tmp_path, 1, 0, wait_for) as feeder:
        text = f'name = "axis1"\ndriver = "serial"\n{nominal_table()}[drive.options]\nport = "{feeder.links[0]}"'
        with daemon("--config", write_config(tmp_path / "c.toml", text), "--state-dir", tmp_path / "state") as program:
            allow(0.5)
            take(program.process.pid)
            program.until(lambda d: program.said("device opened"), "the port is open")
            feeder.tell("go")
            program.until(lambda d: d["samples"] > 5000, "the start, with its re-linearisations, is over")
            assert short(program, feeder) == 0, "with half a core nothing is lost"
            share = wanted_share(program)
            for part in (4, 16, 64):
                allow(share / part)
                with contextlib.suppress(AssertionError):
                    wait_for(lambda: program.said("other programs have the processor"), "it is behind", 20.0 + part)
                    break
            allow(0.5)
            assert "behind" in program.events()
            wait_for(lambda: "behind_over" in program.events(), "it has caught up")
            health = program.estimates()["health"]
            assert health["queue_dropped"] == 0 and "overloaded" not in program.events()
