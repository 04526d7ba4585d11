"""A daemon that gets less of the processor than it wants (systemd's CPUQuota=): it keeps its drive's samples and says
that it is behind."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from benchmarks.soak.drives import drives
from tests.system.harness import DaemonProgram, daemon, nominal_table, wait_for, write_config

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


def sent(feeder: object) -> int:
    (count,) = feeder.tell("count")  # type: ignore[attr-defined]
    assert count["no_room"] == 0, "the terminal held what was sent"
    return int(count["sent"])


def compared(program: DaemonProgram, feeder: object) -> int:
    """How many samples the daemon is short of, once it has worked off what was sent."""
    feeder.tell("pause")  # type: ignore[attr-defined]
    total = sent(feeder)
    end = time.monotonic() + 20.0
    while (short := total - program.estimates()["samples"]) > 0 and time.monotonic() < end:
        time.sleep(0.1)
    feeder.tell("go")  # type: ignore[attr-defined]
    return short


@pytest.mark.slow
@pytest.mark.timeout(200)
def test_a_starved_daemon_keeps_its_samples_and_says_so(missing: Callable[[str], NoReturn], tmp_path: Path) -> None:
    with (
        quota(missing) as (take, allow),
        drives(tmp_path, 1, 0, wait_for) as feeder,
    ):
        text = f'name = "axis1"\ndriver = "serial"\n{nominal_table()}[drive.options]\nport = "{feeder.links[0]}"'
        with daemon("--config", write_config(tmp_path / "c.toml", text), "--state-dir", tmp_path / "state") as program:
            take(program.process.pid)
            allow(50)
            feeder.tell("go")
            program.until(lambda d: d["samples"] > 1000, "samples come")
            short = compared(program, feeder)  # what was sent before the port was open
            time.sleep(3.0)
            assert compared(program, feeder) == short, "with half a core nothing is lost"
            before = program.estimates()["health"]
            allow(3)
            program.until(lambda d: "behind" in program.events(), "it says that it is behind")
            allow(50)
            program.until(lambda d: "behind_over" in program.events(), "it has caught up")
            assert compared(program, feeder) == short, "nothing was lost while it was behind"
            health = program.estimates()["health"]
            assert health["samples_lost"] == before["samples_lost"] and not health["overloaded"]
            assert "overloaded" not in program.events()
