"""The replay driver: a capture as a drive, in real time or faster, once or for ever."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import Driver
from drivers.registry import make_driver
from servo_daemon.captures import read_capture, write_capture
from servo_daemon.captures.driver import ReplayDriver
from servo_daemon.errors import (
    DriverConfigError,
    DriverDisconnectedError,
    DriverError,
    DriverUnavailableError,
    EndOfStreamError,
)
from servo_daemon.samples import Quality, SampleBlock, concatenate, make_block
from tests.drivers.conformance import DriverConformance

SAMPLES = 300
SEAM = Quality.GAP_BEFORE | Quality.TIME_RESTART


@pytest.fixture
def path(tmp_path: Path) -> Path:
    k = np.arange(SAMPLES)
    block = make_block(100.0 + k * 1e-3, voltage_V=np.sin(k), current_A=np.cos(k), position_rad=k / 7)
    write_capture(tmp_path / "bench.csv.gz", block, metadata={"counts_per_rev": "4096"})
    return tmp_path / "bench.csv.gz"


class TestReplayConformance(DriverConformance):
    kind = "replay"
    wrong_types = {"path": 5, "speed": "fast", "loop": "yes", "block_samples": 0.5}  # noqa: RUF012

    @pytest.fixture
    def options(self, path: Path) -> Iterator[dict[str, Any]]:
        yield {"path": str(path)}

    @pytest.fixture
    def silent_options(self, path: Path) -> Iterator[dict[str, Any] | None]:
        yield {"path": str(path), "speed": 1e-6, "block_samples": 100}  # the first block is due in a day

    @pytest.fixture
    def missing_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        yield {"path": str(tmp_path / "nothing.csv")}


def replay(path: Path, **options: Any) -> Driver:
    return make_driver("replay", "axis1", {"path": str(path), **options})


def read_all(driver: Driver) -> list[SampleBlock]:
    blocks: list[SampleBlock] = []
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            block = driver.read(0.1)
        except EndOfStreamError:
            return blocks
        if block is not None:
            blocks.append(block)
    raise AssertionError("the stream did not end")


@pytest.mark.parametrize("speed", [0, "max", 20, 1.5])
@pytest.mark.parametrize("block_samples", [None, 1, 7, 5000])
def test_every_sample_arrives_as_recorded(path: Path, speed: object, block_samples: int | None) -> None:
    options = {} if block_samples is None else {"block_samples": block_samples}
    with replay(path, speed=speed, **options) as driver:
        assert driver.can_wait == (speed in (0, "max"))
        got = concatenate(read_all(driver))
        with pytest.raises(EndOfStreamError, match=r"axis1: end of .*bench\.csv\.gz"):
            driver.read(0.0)
    meant = read_capture(path).block()
    for name in ("time_s", "sequence", "quality", *meant.channels):
        np.testing.assert_array_equal(getattr(got, name), getattr(meant, name))
    assert driver.counters.samples == SAMPLES
    assert driver.counters.device_restarts == driver.counters.samples_lost == 0


@pytest.mark.parametrize(("block_samples", "most"), [(7, 7), (5000, SAMPLES)])
def test_blocks_at_full_speed_have_the_length_asked_for(path: Path, block_samples: int, most: int) -> None:
    with replay(path, speed="max", block_samples=block_samples) as driver:
        lengths = [len(b) for b in read_all(driver)]
    assert set(lengths[:-1]) <= {most}
    assert lengths[-1] == (SAMPLES % block_samples or most)


def test_real_time_is_kept_by_absolute_deadlines(path: Path) -> None:
    start = time.monotonic()
    with replay(path) as driver:
        opened = time.monotonic()
        blocks = read_all(driver)
    for block in blocks:
        # Never before its last sample's own time; how late is the machine's business.
        assert block.host_time_s >= start + (block.time_s[-1] - 100.0)
        assert len(block) % 10 == 0
    assert blocks[-1].host_time_s - opened >= 0.28
    host = [b.host_time_s for b in blocks]
    assert host == sorted(host)


def test_a_late_reader_gets_what_is_due_at_once(path: Path) -> None:
    with replay(path, speed=1000, block_samples=7) as driver:
        deadline = time.monotonic() + 10
        while time.monotonic() < deadline and driver.read(0.0) is None:
            pass
        all_due = time.monotonic() + SAMPLES * 1e-3 / 1000
        while time.monotonic() < all_due:
            pass
        rest = driver.read(0.0)
        assert rest is not None
        assert rest.sequence[-1] == SAMPLES - 1


def test_nothing_is_due_yet(path: Path) -> None:
    with replay(path, speed=0.001) as driver:
        first = driver.read(1.0)  # a block of one sample: 10 ms of this replay is less than one
        assert first is not None and len(first) == 1
        assert driver.read(0.0) is None
        assert driver.read(0.02) is None
        assert driver.counters.samples == 1


def test_a_loop_continues_time_and_numbers_and_flags_the_seam(path: Path) -> None:
    with replay(path, speed="max", loop=True, block_samples=64) as driver:
        blocks: list[SampleBlock] = []
        while sum(map(len, blocks)) < 3 * SAMPLES:
            block = driver.read(1.0)
            assert block is not None
            blocks.append(block)
    got = concatenate(blocks)
    assert np.diff(got.time_s).min() > 0
    np.testing.assert_allclose(np.diff(got.time_s), 1e-3, rtol=1e-6)
    np.testing.assert_array_equal(got.sequence, np.arange(3 * SAMPLES))
    assert np.flatnonzero(got.quality).tolist() == [SAMPLES, 2 * SAMPLES]
    assert set(got.quality[got.quality != 0].tolist()) == {int(SEAM)}
    assert got.position_rad is not None
    np.testing.assert_array_equal(got.position_rad[SAMPLES : 2 * SAMPLES], np.arange(SAMPLES) / 7)


def test_a_loop_in_real_time_keeps_the_schedule_over_the_seam(path: Path) -> None:
    start = time.monotonic()
    with replay(path, speed=10, loop=True) as driver:
        last = start
        samples = 0
        while samples < 2 * SAMPLES + 10:
            block = driver.read(1.0)
            assert block is not None
            samples += len(block)
            last = block.host_time_s
            assert last - start >= (block.time_s[-1] - 100.0) / 10
    assert last - start >= 2 * SAMPLES * 1e-4


def test_opening_again_starts_from_the_beginning_and_says_so(path: Path) -> None:
    driver = replay(path, speed="max", block_samples=100)
    for expected in (0, int(SEAM)):
        with driver:
            block = driver.read(0.1)
            assert block is not None
            assert (block.time_s[0], block.sequence[0], block.quality[0]) == (100.0, 0, expected)
    with driver:
        assert len(concatenate(read_all(driver))) == SAMPLES


def test_info(path: Path) -> None:
    driver = replay(path, speed="max")
    assert driver.info.identity == "capture:bench.csv.gz"
    assert driver.info.sample_period_s is None
    with driver:
        info = driver.info
    assert info.identity == "capture:bench.csv.gz"
    assert info.sample_period_s == pytest.approx(1e-3)
    assert info.counts_per_rev == 4096
    assert info.channels == ("voltage_V", "current_A", "position_rad")
    assert driver.truth() is None


def test_close_ends_a_waiting_read_at_once(path: Path) -> None:
    driver = replay(path, speed=0.001, block_samples=100)  # the first block is due in 99 s
    driver.open()
    outcome: list[object] = []
    reading = threading.Event()

    def reader() -> None:
        reading.set()
        try:
            outcome.append(driver.read(60.0))
        except DriverError as error:
            outcome.append(error)

    thread = threading.Thread(target=reader)
    thread.start()
    assert reading.wait(10)
    driver.close()
    thread.join(10)
    assert not thread.is_alive()
    assert isinstance(outcome[0], DriverError)  # disconnected, or (closed before it began) not open
    with pytest.raises(DriverError, match="read before open"):
        driver.read(0.0)
    assert not isinstance(outcome[0], EndOfStreamError)
    with pytest.raises(DriverDisconnectedError):
        driver._read(0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "option 'path' must name a capture"),
        ({"path": ""}, "option 'path'"),
        ({"path": 3}, "option 'path'"),
        ({"path": "a.csv", "sped": 1}, "unknown option 'sped': known are path, speed, loop, block_samples"),
        ({"path": "a.csv", "speed": -1}, "option 'speed'"),
        ({"path": "a.csv", "speed": "fast"}, "option 'speed'"),
        ({"path": "a.csv", "speed": True}, "option 'speed'"),
        ({"path": "a.csv", "speed": float("inf")}, "option 'speed'"),
        ({"path": "a.csv", "loop": 1}, "option 'loop'"),
        ({"path": "a.csv", "block_samples": 0}, "option 'block_samples'"),
        ({"path": "a.csv", "block_samples": 2.5}, "option 'block_samples'"),
    ],
)
def test_wrong_options_are_refused_without_touching_the_file(options: dict[str, Any], message: str) -> None:
    with pytest.raises(DriverConfigError, match=message):
        ReplayDriver("axis1", options)


def test_a_missing_capture_may_come_and_a_bad_one_is_wrong_for_good(tmp_path: Path, path: Path) -> None:
    driver = replay(tmp_path / "late.csv.gz", speed="max")
    with pytest.raises(DriverUnavailableError, match=r"axis1: replay: .*late\.csv\.gz: cannot be read: No such file"):
        driver.open()
    assert not driver.is_open
    path.rename(tmp_path / "late.csv.gz")
    with driver:
        assert len(concatenate(read_all(driver))) == SAMPLES
    bad = tmp_path / "bad.csv"
    bad.write_text("time_s,voltage_V,position_rad\n0,1,2\n1,x,2\n")
    with pytest.raises(DriverConfigError, match=r"bad\.csv, line 3, column voltage_V: 'x' is not a number"):
        replay(bad).open()
