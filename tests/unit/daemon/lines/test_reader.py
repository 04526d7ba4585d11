"""The reader thread: reconnects with back-off, says each change once, and counts what it drops."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np
import pytest

from drivers.base import DriveInfo, Driver
from servo_daemon.daemon.lines import reader as reader_module
from servo_daemon.daemon.lines.reader import BlockQueue, Reader
from servo_daemon.errors import (
    DriverConfigError,
    DriverDisconnectedError,
    DriverUnavailableError,
    EndOfStreamError,
)
from servo_daemon.samples import Quality, SampleBlock, make_block

PATIENCE_S = 20.0

Step = SampleBlock | Exception | None


def block(first: int, n: int = 10) -> SampleBlock:
    k = first + np.arange(n)
    return make_block(k * 1e-3, sequence=k, current_A=k * 1.0)


class Scripted(Driver):
    """A driver that does what the test says.

    Args:
        attempts: for each `open` either the error it raises or what `read` then gives, in order; when that is used up
            `read` waits as a silent device does.
    """

    kind: ClassVar[str] = "scripted"

    def __init__(self, *attempts: Exception | list[Step]) -> None:
        super().__init__("axis1", {})
        self._attempts = iter(attempts)
        self._steps: Iterator[Step] = iter(())
        self._closed = threading.Event()
        self.opens: list[float] = []
        self.closes = 0

    @property
    def info(self) -> DriveInfo:
        return DriveInfo("scripted")

    def _open(self) -> None:
        self.opens.append(time.monotonic())
        attempt = next(self._attempts, [])
        if isinstance(attempt, Exception):
            raise attempt
        self._steps = iter(attempt)
        self._closed.clear()

    def _read(self, timeout_s: float) -> SampleBlock | None:
        step = next(self._steps, "silence")
        if isinstance(step, Exception):
            raise step
        if step == "silence":
            self._closed.wait(timeout_s)
            return None
        assert step is None or isinstance(step, SampleBlock)
        return step

    def _close(self) -> None:
        self.closes += 1
        self._closed.set()


class Watched:
    """A reader and what it said."""

    def __init__(self, driver: Scripted) -> None:
        self.driver = driver
        self.said: list[tuple[str, str]] = []
        self.woken = 0
        self.reader = Reader(driver, self._wake, lambda kind, message: self.said.append((kind, message)))

    def _wake(self) -> None:
        self.woken += 1

    @property
    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.said]

    def until(self, condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f"{what}: {self.said}, {self.reader.link}"
            time.sleep(0.002)


@pytest.fixture
def start() -> Iterator[Callable[..., Watched]]:
    running: list[Watched] = []

    def begin(*attempts: Exception | list[Step]) -> Watched:
        watched = Watched(Scripted(*attempts))
        running.append(watched)
        watched.reader.start()
        return watched

    yield begin
    for watched in running:
        watched.reader.stop(PATIENCE_S)
        assert not watched.reader.alive


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_module, "_BACKOFF_FIRST_S", 0.01)
    monkeypatch.setattr(reader_module, "_BACKOFF_LONGEST_S", 0.08)


def lost(why: str = "unplugged") -> DriverDisconnectedError:
    return DriverDisconnectedError(f"drive axis1: device went away: {why}")


def missing() -> DriverUnavailableError:
    return DriverUnavailableError("drive axis1: no such port")


def test_blocks_arrive_in_order(start: Callable[..., Watched]) -> None:
    w = start([block(0), None, block(10), block(20)])
    w.until(lambda: w.reader.queue.samples == 30, "all blocks")
    taken = w.reader.queue.take()
    assert [int(b.sequence[0]) for b in taken] == [0, 10, 20]
    assert w.reader.queue.samples == 0 and w.reader.queue.take() == []
    w.until(lambda: w.woken >= 4, "woken for the opened line and each block")
    assert w.said == [("connected", "device opened")]
    assert w.reader.link.connection == "connected" and w.reader.link.reason is None
    assert w.reader.reconnects == 0


@pytest.mark.usefixtures("quick")
def test_missing_at_start_is_said_once_and_tried_with_back_off(start: Callable[..., Watched]) -> None:
    w = start(*[missing() for _ in range(8)], [block(0)])
    w.until(lambda: w.driver.opens, "first attempt")
    w.until(lambda: w.reader.link.connection == "connected", "opened at last")
    assert w.said == [("unavailable", "no such port"), ("connected", "device opened")]
    pauses = np.diff(w.driver.opens)
    wanted = np.minimum(0.01 * 2.0 ** np.arange(8), 0.08)
    assert (pauses >= wanted - 1e-4).all(), "each failure doubles the pause, up to the longest"
    assert w.reader.reconnects == 0


def test_the_reason_of_a_missing_device_is_public(start: Callable[..., Watched]) -> None:
    w = start(*[missing() for _ in range(50)])
    w.until(lambda: w.reader.link.reason != "not opened yet", "first attempt failed")
    assert w.reader.link.connection == "connecting"
    assert w.reader.link.reason is not None
    assert w.reader.link.reason.startswith("no such port; next attempt in 0.25 s")


@pytest.mark.usefixtures("quick")
def test_unplugged_and_back_is_said_once_each(start: Callable[..., Watched]) -> None:
    w = start([block(0), lost()], missing(), missing(), [block(100), lost("again")], [block(200)])
    w.until(lambda: w.reader.queue.samples == 30, "the last attachment's samples")
    assert w.said == [
        ("connected", "device opened"),
        ("disconnected", "device went away: unplugged"),
        ("connected", "device is back"),
        ("disconnected", "device went away: again"),
        ("connected", "device is back"),
    ]
    assert w.reader.reconnects == 2
    assert w.driver.closes == 2


def test_down_until_it_is_back(start: Callable[..., Watched]) -> None:
    w = start([block(0), lost()], *[missing() for _ in range(50)])
    w.until(lambda: w.reader.link.connection == "down", "down")
    w.until(lambda: "no such port" in str(w.reader.link.reason), "the reason is the last one")
    assert w.reader.link.connection == "down", "not 'connecting': it has been there"
    assert w.kinds == ["connected", "disconnected"]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("error", [lost(), RuntimeError("a bug in the driver")], ids=["lost", "bug"])
def test_a_device_that_opens_and_fails_at_once_backs_off_and_is_said_once(
    start: Callable[..., Watched], error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    w = start([block(0), lost()], *[[error] for _ in range(9)], [block(1)])
    w.until(lambda: w.reader.queue.samples == 20, "it works in the end")
    # Down, one hopeful "back", down again; then nothing until a sample comes.
    assert w.kinds == ["connected", "disconnected", "connected", "disconnected", "connected"]
    pauses = np.diff(w.driver.opens)
    assert pauses[-1] >= 0.08 - 1e-4, "an attachment without a sample does not reset the back-off"
    bugs = [r for r in caplog.records if r.exc_info]
    assert len(bugs) == (1 if isinstance(error, RuntimeError) else 0), "the traceback once, too"


def test_a_bug_in_a_driver_does_not_end_its_life(
    start: Callable[..., Watched], caplog: pytest.LogCaptureFixture
) -> None:
    w = start([block(0), ZeroDivisionError()], [block(10)])
    w.until(lambda: w.reader.queue.samples == 20, "it goes on")
    assert w.said[1] == ("disconnected", "ZeroDivisionError")
    assert "driver failed" in caplog.text and caplog.records[0].levelno == logging.ERROR


def test_wrong_options_are_not_tried_again(start: Callable[..., Watched]) -> None:
    w = start(DriverConfigError("drive axis1: no such interface"))
    w.until(lambda: not w.reader.alive, "given up")
    assert w.said == [("misconfigured", "no such interface")]
    assert w.reader.link.connection == "down" and len(w.driver.opens) == 1


def test_a_finite_source_ends(start: Callable[..., Watched]) -> None:
    w = start([block(0), EndOfStreamError("drive axis1: end of x.csv")])
    w.until(lambda: not w.reader.alive, "ended")
    assert w.kinds == ["connected", "ended"]
    assert (w.reader.link.connection, w.reader.link.reason) == ("ended", "end of x.csv")
    assert w.reader.queue.samples == 10, "what it brought is still there"
    assert w.driver.closes == 1


def test_an_open_line_without_samples_is_silent(start: Callable[..., Watched], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_module, "SILENT_AFTER_S", 0.05)
    w = start([])
    w.until(lambda: w.kinds == ["connected"], "opened")
    w.until(lambda: w.reader.link.connection == "silent", "silent")
    assert str(w.reader.link.reason).startswith("open, but no samples for ")


def test_a_line_that_nobody_has_read_is_not_silent_and_its_samples_have_waited(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that gets no processor for seconds knows nothing of the drive, and is late."""
    now = [100.0]
    monkeypatch.setattr(reader_module.time, "monotonic", lambda: now[0])
    reader = Reader(Scripted([]), lambda: None, lambda *_: None)
    reader._set("connected", None)
    reader._take(block(0))
    now[0] += 5.0
    assert reader.link.connection == "connected"
    reader._take(block(1), reader._looked_s)
    reader.queue.take(10)
    assert reader.queue.waited_s(now[0]) == 5.0
    now[0] += 5.0
    reader._take(None)
    assert reader.link.connection == "silent"


def test_a_reopened_line_is_connected_from_its_first_sample_on(start: Callable[..., Watched]) -> None:
    w = start([block(0), lost()], [])
    w.until(lambda: w.reader.reconnects == 1, "open again")
    assert w.reader.link.connection in ("connecting", "silent"), "the samples before do not count"
    assert w.reader.link.reason is not None


def test_stop_ends_a_waiting_read_and_closes_the_device(start: Callable[..., Watched]) -> None:
    w = start([block(0)])
    w.until(lambda: w.reader.queue.samples == 10, "running")
    w.reader.request_stop()
    w.reader.stop(PATIENCE_S)
    w.reader.stop(PATIENCE_S)
    assert not w.reader.alive and not w.driver.is_open
    assert w.reader.link.connection == "connected", "what was well until the stop may be saved"


def test_stop_ends_a_pause_between_attempts(start: Callable[..., Watched], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_module, "_BACKOFF_FIRST_S", 1000.0)
    w = start(missing())
    w.until(lambda: w.kinds == ["unavailable"], "pausing")
    w.reader.stop(PATIENCE_S)
    assert not w.reader.alive


def test_a_full_queue_drops_the_oldest_counts_them_and_flags_the_hole() -> None:
    queue = BlockQueue(capacity=25)
    for first in range(0, 60, 10):
        queue.put(block(first))
    kept = queue.take()
    assert [int(b.sequence[0]) for b in kept] == [40, 50]
    assert queue.dropped == 40 and sum(map(len, kept)) + queue.dropped == 60
    assert kept[0].quality[0] == Quality.GAP_BEFORE
    assert not kept[0].quality[1:].any() and not kept[1].quality.any()
    queue.put(block(60))
    (after,) = queue.take()
    assert not after.quality.any()


def test_a_block_larger_than_the_queue_is_kept() -> None:
    queue = BlockQueue(capacity=5)
    queue.put(block(0, 50))
    assert queue.samples == 50 and queue.dropped == 0
    queue.put(block(50, 50))
    assert [int(b.sequence[0]) for b in queue.take()] == [50] and queue.dropped == 50


def test_a_queue_gives_whole_blocks_of_about_so_many_samples() -> None:
    queue = BlockQueue()
    for first in range(0, 50, 10):
        queue.put(block(first))
    assert [[int(b.sequence[0]) for b in queue.take(15)] for _ in range(4)] == [[0, 10], [20, 30], [40], []]
    assert queue.samples == 0 and queue.dropped == 0


def test_a_device_is_opened_later_where_that_is_asked_and_not_at_all_after_a_stop() -> None:
    w, began = Watched(Scripted([block(0)])), time.monotonic()
    w.reader.start(after_s=0.05)
    w.until(lambda: w.reader.queue.samples, "opened")
    assert time.monotonic() - began >= 0.05
    w.reader.stop(PATIENCE_S)
    stopped = Watched(Scripted([block(0)]))
    stopped.reader.start(after_s=2 * PATIENCE_S)
    stopped.reader.stop(PATIENCE_S)
    assert not stopped.reader.alive and stopped.said == [] and stopped.reader.queue.samples == 0


def test_a_source_that_can_wait_is_read_no_faster_than_it_is_worked_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_module, "_AHEAD_SAMPLES", 25)
    driver = Scripted([block(first) for first in range(0, 1000, 10)])
    monkeypatch.setattr(Scripted, "can_wait", True)
    w = Watched(driver)
    longest, taken = [0], []
    monkeypatch.setattr(w.reader, "_wake", lambda: longest.append(w.reader.queue.samples))
    w.reader.start()
    try:
        w.until(lambda: w.reader.queue.samples > 25, "ahead")
        while len(taken) < 100:
            taken += w.reader.queue.take(10)
            time.sleep(0)
        assert max(longest) == 30, "a block more than that at the most"
        assert [int(b.sequence[0]) for b in taken] == list(range(0, 1000, 10))
        assert w.reader.queue.dropped == 0
    finally:
        w.reader.stop(PATIENCE_S)


def test_nothing_is_lost_between_two_threads() -> None:
    queue, taken, done = BlockQueue(capacity=200), [], threading.Event()

    def consume() -> None:
        while not done.is_set() or queue.samples:
            taken.extend(queue.take())

    consumer = threading.Thread(target=consume)
    consumer.start()
    for first in range(0, 20_000, 10):
        queue.put(block(first))
    done.set()
    consumer.join(PATIENCE_S)
    numbers = np.concatenate([b.sequence for b in taken])
    assert (np.diff(numbers) > 0).all()
    assert len(numbers) + queue.dropped == 20_000
    holes = np.flatnonzero(np.diff(numbers, prepend=-1) > 1)
    quality = np.concatenate([b.quality for b in taken])
    assert np.array_equal(np.flatnonzero(quality), holes), "every hole, and nothing else, is flagged"
