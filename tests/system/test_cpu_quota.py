"""A daemon that gets less of the processor than it wants (systemd's CPUQuota=): it keeps its drive's samples and says
that it is behind."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from benchmarks.soak.drives import Drives, drives
from tests.system.harness import PATIENCE_S, DaemonProgram, daemon, nominal_table, wait_for, write_config

_ROOT = Path("/sys/fs/cgroup")
_PERIOD_US = 100_000


@contextlib.contextmanager
def quota(missing: Callable[[str], NoReturn]) -> Iterator[tuple[Callable[[int], object], Callable[[int], object]]]:
    """Functions: take a process in; allow it so many percent of a core. Control groups of either version."""
    one = (_ROOT / "cpu").is_dir()
    group = (_ROOT / "cpu" if one else _ROOT) / f"servo-daemon-test-{time.monotonic_ns()}"
    name = "cpu.cfs_quota_us" if one else "cpu.max"
    try:
        if not one:
            (_ROOT / "cgroup.subtree_control").write_text("+cpu")
        group.mkdir()
        (group / name).write_text("-1" if one else f"max {_PERIOD_US}")
    except OSError as error:
        with contextlib.suppress(OSError):
            group.rmdir()
        missing(f"a control group for the processor: {error}")

    def allow(percent: int) -> None:
        us = str(percent * _PERIOD_US // 100)
        (group / name).write_text(us if one else f"{us} {_PERIOD_US}")

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


@pytest.mark.slow
def test_a_starved_daemon_keeps_its_samples_and_says_so(missing: Callable[[str], NoReturn], tmp_path: Path) -> None:
    """Half a core is plenty for one drive. With a few hundredths it cannot keep up, and the port's own memory may run
    over; what it has read is used nevertheless."""
    with quota(missing) as (take, allow), drives(tmp_path, 1, 0, wait_for) as feeder:
        text = f'name = "axis1"\ndriver = "serial"\n{nominal_table()}[drive.options]\nport = "{feeder.links[0]}"'
        with daemon("--config", write_config(tmp_path / "c.toml", text), "--state-dir", tmp_path / "state") as program:
            allow(50)
            take(program.process.pid)
            program.until(lambda d: program.said("device opened"), "the port is open")
            feeder.tell("go")
            program.until(lambda d: d["samples"] > 5000, "the start, with its re-linearisations, is over")
            assert short(program, feeder) == 0, "with half a core nothing is lost"
            for percent, within_s in ((4, 15.0), (2, 15.0), (1, 60.0)):  # how little is too little: the machine's
                allow(percent)
                with contextlib.suppress(AssertionError):
                    wait_for(lambda: "behind" in program.events(), "it says that it is behind", within_s, every_s=1.0)
                    break
            assert "behind" in program.events()
            allow(50)
            wait_for(lambda: "behind_over" in program.events(), "it has caught up")
            health = program.estimates()["health"]
            assert health["queue_dropped"] == 0 and "overloaded" not in program.events()
