"""Samples around events: which are kept, that they are those, and that the folder stays within its quota."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import DriveInfo
from servo_daemon.captures import read_capture
from servo_daemon.config import DriveConfig, parse_config
from servo_daemon.daemon.captures import coordinator as coordinator_module
from servo_daemon.daemon.captures.coordinator import CaptureCoordinator
from servo_daemon.daemon.captures.folder import CaptureFolder
from servo_daemon.daemon.daemon import Daemon
from servo_daemon.errors import BusyError, RefusedError, ServoDaemonError
from servo_daemon.pipeline.event_log import EventLog
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.published.snapshot import Connection, Snapshot
from servo_daemon.samples import make_block
from servo_daemon.signal_meaning import SignalMeaning

RATE_HZ = 100.0
#: Events carry the real time: samples are later, so that the end of a capture is that of its samples.
START = time.time() + 86_400.0


@dataclass
class Drive:
    """A `coordinator.Source` whose samples are its device time."""

    name: str = "axis1"
    active: DriveConfig = field(default_factory=DriveConfig)
    info: DriveInfo = field(default_factory=lambda: DriveInfo("motor 7"))
    meaning: SignalMeaning = field(default_factory=SignalMeaning)
    ring: SampleRing = field(default_factory=lambda: SampleRing(60.0))
    connection: Connection = "connected"
    now: float = 0.0

    def __post_init__(self) -> None:
        self.log = EventLog(self.name)

    def snapshot(self) -> Snapshot:
        return Snapshot(self.name, "simulated", START + self.now, self.connection, None, None, {})

    def run(self, seconds: float) -> None:
        for _ in range(round(10 * seconds)):
            time = self.now + np.arange(1, 11) / RATE_HZ
            self.ring.append(make_block(time, voltage_V=time * 2, current_A=-time, position_rad=time / 3))
            self.now = round(self.now + 0.1, 6)


@pytest.fixture
def drive() -> Drive:
    made = Drive()
    made.run(70)
    return made


def coordinator_of(drive: Drive, folder: Path, quota: float = 1e9) -> CaptureCoordinator:
    return CaptureCoordinator(CaptureFolder(folder, quota), [drive])


@pytest.mark.parametrize("ending", ["parquet", "csv.gz"])
def test_the_minute_around_an_event(drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str) -> None:
    if ending == "csv.gz":
        monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    coordinator = coordinator_of(drive, tmp_path)
    drive.log.add("alarm", "R is above its limit")
    coordinator.turn(0.0)
    assert coordinator.of("axis1") == ()  # what comes after it is not there yet
    drive.run(29)
    drive.log.add("model_mismatch", "is in the same capture")
    coordinator.turn(29.0)
    drive.run(1)
    coordinator.turn(30.0)
    (kept,) = coordinator.of("axis1")
    assert kept.path.name.endswith(f"-alarm.{ending}") and kept.size == kept.path.stat().st_size
    capture = read_capture(kept.path)
    assert (capture.time_s[0], capture.time_s[-1]) == pytest.approx((40.01, 100.0))
    assert np.allclose(np.diff(capture.time_s), 1 / RATE_HZ)
    assert capture.voltage_V is not None and np.array_equal(capture.voltage_V, capture.time_s * 2)
    assert capture.metadata["event"] == "alarm" and capture.metadata["identity"] == "motor 7"
    assert (kept.start, kept.end) == pytest.approx((START + 40.01, START + 100.0), abs=2e-3)


def test_what_a_diagnosis_begins_with_is_kept_at_once(drive: Drive, tmp_path: Path) -> None:
    coordinator = coordinator_of(drive, tmp_path)
    drive.log.add("refreshed", "says nothing of the samples")
    drive.log.add("diagnosis_started", "…")
    coordinator.turn(0.0)
    (kept,) = coordinator.of("axis1")
    assert kept.kind == "diagnosis_started" and read_capture(kept.path).time_s[[0, -1]] == pytest.approx([10.01, 70])


def test_a_drive_that_goes_away_leaves_the_minute_before(drive: Drive, tmp_path: Path) -> None:
    coordinator = coordinator_of(drive, tmp_path)
    drive.log.add("alarm", "…")
    coordinator.turn(0.0)
    drive.connection = "down"
    drive.ring.clear()
    drive.now = 0.0  # the device has restarted
    drive.run(2)
    coordinator.turn(2.0)
    assert read_capture(coordinator.of("axis1")[0].path).time_s[[0, -1]] == pytest.approx([10.01, 70])


def test_a_drive_that_leaves_the_configuration_leaves_its_samples(drive: Drive, tmp_path: Path) -> None:
    coordinator = coordinator_of(drive, tmp_path)
    drive.log.add("alarm", "…")
    coordinator.turn(0.0)
    other = Drive()  # of the same name: with options of its own
    coordinator.follow([other])
    other.run(5)
    other.log.add("diagnosis_started", "…")
    coordinator.turn(1.0)
    assert [k.kind for k in coordinator.of("axis1")] == ["alarm", "diagnosis_started"]
    assert read_capture(coordinator.of("axis1")[1].path).time_s[[0, -1]] == pytest.approx([0.01, 5])
    coordinator.follow([])
    with pytest.raises(BusyError, match="has gone"):
        coordinator.request("axis1", 5.0)


def test_an_alarm_that_comes_and_goes_is_not_kept_each_time(drive: Drive, tmp_path: Path) -> None:
    coordinator = coordinator_of(drive, tmp_path)
    for minute in range(12):
        drive.log.add("alarm", "…")
        coordinator.turn(60.0 * minute)
        drive.run(60)
        coordinator.turn(60.0 * minute + 59)
    assert len(coordinator.of("axis1")) == 2  # in the first minute, and after ten


def test_the_oldest_go_beyond_the_quota_and_the_rest_outlives_a_restart(drive: Drive, tmp_path: Path) -> None:
    one = CaptureFolder(tmp_path / "one", 1e9).store("axis1", "request", START, START + 60, drive.ring.blocks(), {})
    coordinator = coordinator_of(drive, tmp_path / "many", 3.5 * one.size)
    for k in range(6):
        drive.run(1)
        future = coordinator.request("axis1", 60.0)
        coordinator.turn(float(k))
        newest = future.result(0)
    kept = coordinator.of("axis1")
    assert len(kept) == 3 and kept[-1] == newest
    assert sorted(p.name for p in (tmp_path / "many" / "axis1").iterdir()) == [k.path.name for k in kept]
    (tmp_path / "many" / "axis1" / ".20261127T023001123Z-1ms-alarm.parquet.0a.part").touch()
    (tmp_path / "many" / "axis1" / "notes.txt").touch()
    again = CaptureFolder(tmp_path / "many", 1e9)
    assert again.of("axis1") == kept
    assert not list((tmp_path / "many" / "axis1").glob(".*"))


def test_requests_are_cut_to_what_is_asked_for_and_refused_in_words(drive: Drive, tmp_path: Path) -> None:
    coordinator = coordinator_of(drive, tmp_path)
    future = coordinator.request("axis1", 5.0)
    coordinator.turn(0.0)
    assert read_capture(future.result(0).path).time_s[[0, -1]] == pytest.approx([65.01, 70], abs=0.1)
    for _ in range(8):
        coordinator.request("axis1", 5.0)
    with pytest.raises(BusyError, match="wait to be written"):
        coordinator.request("axis1", 5.0)
    drive.ring = SampleRing(0.0)
    with pytest.raises(RefusedError, match="ring_s = 0"):
        coordinator.request("axis1", 5.0)


def test_a_disk_that_refuses_is_told_and_nothing_else_suffers(drive: Drive, tmp_path: Path) -> None:
    (tmp_path / "captures").touch()  # where the folder should be
    coordinator = coordinator_of(drive, tmp_path / "captures")
    drive.log.add("diagnosis_started", "…")
    future = coordinator.request("axis1", 5.0)
    coordinator.turn(0.0)
    with pytest.raises(ServoDaemonError):
        future.result(0)
    assert coordinator.problem is not None and "captures cannot be kept" in coordinator.problem
    (tmp_path / "captures").unlink()
    coordinator.turn(1.0)
    assert coordinator.problem is not None  # it is not tried at each turn
    coordinator.turn(2.0)
    assert coordinator.problem is None and [k.kind for k in coordinator.of("axis1")] == ["diagnosis_started"]


def test_what_waits_for_a_disk_is_bounded(drive: Drive, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "captures").touch()
    coordinator = coordinator_of(drive, tmp_path / "captures")
    for k in range(6):
        drive.log.add("diagnosis_started", "…")
        coordinator.turn(1000.0 * k)
    assert caplog.text.count("the capture of diagnosis_started is lost") == 2
    coordinator.turn(1e4, end=True)
    assert caplog.text.count("the capture of diagnosis_started is lost") == 6


def test_samples_that_are_no_measurements_are_no_problem_of_the_daemon(tmp_path: Path) -> None:
    drive = Drive()
    nothing = np.full(20, np.nan)
    drive.ring.append(make_block(np.arange(20) / 10, voltage_V=nothing, current_A=nothing, position_rad=nothing))
    coordinator = coordinator_of(drive, tmp_path)
    cancelled, asked = coordinator.request("axis1", 5.0), coordinator.request("axis1", 5.0)
    assert cancelled.cancel()
    drive.log.add("diagnosis_started", "…")
    coordinator.turn(0.0)
    with pytest.raises(BusyError, match="no sample of the recording"):
        asked.result(0)
    assert coordinator.problem is None and coordinator.of("axis1") == ()


def test_the_thread_writes_what_is_asked_for(drive: Drive, tmp_path: Path) -> None:
    coordinator = coordinator_of(drive, tmp_path)
    coordinator.start()
    assert coordinator.request("axis1", 5.0).result(30.0).kind == "request"
    drive.log.add("alarm", "at the end with what there is of it")
    coordinator.stop(30.0)
    assert [k.kind for k in coordinator.of("axis1")] == ["request", "alarm"]


@pytest.mark.parametrize(
    ("history", "with_state", "are_kept"),
    [({}, True, True), ({}, False, False), ({"captures_quota_MB": 0}, True, False), ({"enabled": False}, True, False)],
)
def test_where_they_are_kept(history: dict[str, Any], with_state: bool, are_kept: bool, tmp_path: Path) -> None:
    daemon = Daemon(parse_config({"history": history}), tmp_path if with_state else None)
    assert (daemon.captures is not None) == are_kept


def test_the_kinds_are_events_that_there_are(repo_root: Path) -> None:
    sources = "".join(p.read_text(encoding="utf-8") for p in (repo_root / "servo_daemon").rglob("*.py"))
    told = sources.replace(Path(coordinator_module.__file__).read_text(encoding="utf-8"), "")
    assert [kind for kind in coordinator_module.KINDS if f'"{kind}"' not in told] == []
