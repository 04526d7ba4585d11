"""A worker that does not keep up: what it leaves out, what is said of it, when it is over. The clock is the test's."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import pytest

from servo_daemon.api.documents import estimates_document
from servo_daemon.config import DriveConfig
from servo_daemon.daemon import drive as drive_module
from servo_daemon.daemon import load as load_module
from servo_daemon.daemon.drive import DriveRuntime
from servo_daemon.daemon.lines.reader import BlockQueue
from servo_daemon.daemon.load import CALM_S, KEPT_S, LATE_S, PATIENCE_S, Backlog, LoadWatch
from servo_daemon.published.metrics import render_metrics
from servo_daemon.samples import Quality, SampleBlock, make_block
from servo_daemon.simulate import DEFAULT_NOMINAL
from tests.daemon_rig import Fed

BLOCK_S, BLOCK = 0.05, 10


def block(number: int) -> SampleBlock:
    k = number * BLOCK + np.arange(BLOCK)
    return make_block(k * BLOCK_S / BLOCK, sequence=k, current_A=k * 1.0)


class Line:
    """Blocks arrive every `BLOCK_S`; a worker takes one, sometimes, before which it asks whether it keeps up."""

    def __init__(self, capacity: int = 100_000) -> None:
        self.queue, self.watch = BlockQueue(capacity), LoadWatch()
        self.now_s, self.arrived = 0.0, 0
        self.taken: list[SampleBlock] = []
        self.told: list[tuple[str, float]] = []

    def run(self, seconds: float, blocks_per_s: float) -> None:
        """The worker's rounds are evenly spread, and each works off a block."""
        end, round_s, last = self.now_s + seconds, 1 / blocks_per_s, self.now_s
        while self.now_s < end:
            self.now_s += BLOCK_S
            self.queue.put(block(self.arrived), self.now_s)
            self.arrived += 1
            while last + round_s <= self.now_s:
                last += round_s
                self.told += [(kind, self.now_s) for kind, _, _ in self.watch.relieve(self.queue, self.now_s)]
                self.taken += self.queue.take(1)

    @property
    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.told]


def test_a_worker_that_keeps_up_is_left_alone() -> None:
    line = Line()
    line.run(120.0, blocks_per_s=25.0)
    assert line.told == [] and line.queue.dropped == 0 and not line.watch.overloaded


def test_what_took_long_once_is_worked_off_without_loss() -> None:
    """As a first compilation: fifteen seconds without a round, and then ten times as fast as the samples come."""
    line = Line()
    line.run(15.0, blocks_per_s=1e-3)
    line.run(10.0, blocks_per_s=200.0)
    assert line.told == [] and line.queue.dropped == 0
    assert [int(b.sequence[0]) for b in line.taken] == [BLOCK * k for k in range(len(line.taken))]
    assert line.queue.waited_s(line.now_s) < LATE_S


def test_who_catches_up_slowly_loses_nothing() -> None:
    """Half a minute without a round, and then only an eighth faster than the samples come."""
    line = Line()
    line.run(30.0, blocks_per_s=1e-3)
    line.run(250.0, blocks_per_s=22.5)
    assert line.told == [] and line.queue.dropped == 0
    assert line.queue.waited_s(line.now_s) < LATE_S


def test_the_backlog_of_all_falls_while_they_catch_up_and_not_when_it_stands_or_grows() -> None:
    backlog, falls = Backlog(), []
    for k, waited_s in enumerate([0.0, 0.0, 30.0, 20.0, 10.0, 9.95, 30.0, 0.0, 0.0]):
        backlog.see(waited_s, (k + 1) * PATIENCE_S)
        backlog.see(1e3, (k + 1.5) * PATIENCE_S)  # between two looks: nothing is said
        falls.append(backlog.falls)
    assert falls == [False, False, False, True, True, False, False, True, False]


def test_a_worker_that_is_too_slow_loses_the_oldest_seldom_and_counts_them() -> None:
    line = Line()
    line.run(120.0, blocks_per_s=14.0)  # of 20 that come
    assert line.kinds == ["overloaded"], "said once"
    assert line.told[0][1] >= PATIENCE_S and line.watch.overloaded
    assert BLOCK * len(line.taken) + line.queue.samples + line.queue.dropped == BLOCK * line.arrived
    assert line.queue.dropped == pytest.approx(0.3 * BLOCK * line.arrived, rel=0.1), "no more than it cannot work off"
    numbers = np.concatenate([b.sequence for b in line.taken])
    holes = np.flatnonzero(np.diff(numbers) > 1) + 1
    flagged = np.flatnonzero(np.concatenate([b.quality for b in line.taken]) & Quality.GAP_BEFORE)
    assert flagged.tolist() == holes.tolist(), "each hole is flagged"
    stretch_s = np.diff(holes) * BLOCK_S / BLOCK
    assert stretch_s.min() > 2.0, "seconds in a row between two holes"
    assert line.queue.waited_s(line.now_s) < LATE_S + 0.5, "what is published is of now"


def test_it_is_over_once_it_has_kept_up_for_long() -> None:
    line = Line()
    line.run(60.0, blocks_per_s=14.0)
    assert line.watch.overloaded
    began = line.now_s
    line.run(CALM_S - 2.0, blocks_per_s=100.0)
    assert line.watch.overloaded, "not at once"
    line.run(10.0, blocks_per_s=100.0)
    assert line.kinds == ["overloaded", "overload_over"] and not line.watch.overloaded
    assert CALM_S < line.told[-1][1] - began < CALM_S + 5.0
    dropped = line.queue.dropped
    line.run(60.0, blocks_per_s=100.0)
    assert line.kinds == ["overloaded", "overload_over"] and line.queue.dropped == dropped


def test_one_that_only_just_does_not_keep_up_is_not_told_as_over_in_between() -> None:
    line = Line()
    line.run(900.0, blocks_per_s=19.5)
    assert line.kinds == ["overloaded"]
    assert line.queue.dropped > 0


def test_who_waits_for_the_processor_keeps_its_samples_and_tells_that_it_is_behind() -> None:
    """Little of a processor is left for a minute, in which half is worked off of what comes."""
    queue, watch, told, taken, used_s = BlockQueue(), LoadWatch(), [], 0, 0.0
    for k in range(2400):
        now_s = k * BLOCK_S
        queue.put(block(k), now_s)
        share = 0.05 if k < 1200 else 1.0
        used_s += share * BLOCK_S
        told += [kind for kind, _, _ in watch.relieve(queue, now_s, used_s)]
        if k % 2 == 0 or share == 1.0:
            taken += len(queue.take(BLOCK if share < 1.0 else 10 * BLOCK))
        assert watch.behind == (told[-1:] == ["behind"])
    assert told == ["behind", "behind_over"] and not watch.overloaded
    assert queue.dropped == 0 and taken + len(queue.take()) == 2400


def test_a_full_queue_is_told_at_once() -> None:
    line = Line(capacity=10 * BLOCK)
    line.run(2.0, blocks_per_s=1.0)
    assert line.kinds == ["overloaded"] and line.queue.dropped > 0


def test_the_newest_stay() -> None:
    queue, watch = BlockQueue(), LoadWatch()
    for number in range(200):
        queue.put(block(number), number * BLOCK_S)
    now_s = 199 * BLOCK_S
    assert watch.relieve(queue, now_s) == [], "late for the first time"
    ((kind, _, data),) = watch.relieve(queue, now_s + PATIENCE_S)
    assert kind == "overloaded" and data["waited_s"] == pytest.approx(now_s + PATIENCE_S)
    assert [int(b.sequence[0]) for b in queue.take()] == [1990], "the last block stays in any case"
    for number in range(200, 400):
        queue.put(block(number), number * BLOCK_S)
    now_s = 399 * BLOCK_S
    assert watch.relieve(queue, now_s) == []
    assert now_s - KEPT_S - BLOCK_S <= queue.take()[0].time_s[0] <= now_s - KEPT_S + BLOCK_S


def test_a_drive_tells_it_in_health_events_and_metrics(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Fed("axis1", {})
    drive = DriveRuntime(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), driver, None, lambda: None)
    monkeypatch.setattr(load_module, "PATIENCE_S", 0.0)
    monkeypatch.setattr(load_module, "CALM_S", 0.0)
    long_ago = time.monotonic() - 10.0
    for _ in range(3):
        drive.reader.queue.put(driver.source.next_block(100), long_ago)
    assert estimates_document(drive, drive.snapshot())["health"]["overloaded"] is False
    assert drive.work()
    health = estimates_document(drive, drive.snapshot())["health"]
    assert health["overloaded"] is True
    assert health["queue_dropped"] == health["samples_lost"] == 200
    assert [e.kind for e in drive.events()][-1] == "overloaded"
    assert 'servo_daemon_overloaded{drive="axis1"} 1' in render_metrics(One(drive))
    assert not drive.work()  # nothing waits: the drop was seen
    assert not drive.work()
    assert estimates_document(drive, drive.snapshot())["health"]["overloaded"] is False
    assert drive.events()[-1].kind == "overload_over" and drive.events()[-1].data == {"samples_lost": 200}
    assert 'servo_daemon_overloaded{drive="axis1"} 0' in render_metrics(One(drive))


def test_a_slow_engine_has_short_rounds_and_does_not_start_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else those that wait for their turn wait for seconds, and two slow drives are each late by the other's start."""
    driver = Fed("axis1", {})
    drive = DriveRuntime(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), driver, None, lambda: None)
    used_s, rounds, cost_s = 0.0, list[int](), 4e-3

    def work_off(blocks: Sequence[SampleBlock]) -> None:
        nonlocal used_s
        rounds.append(sum(map(len, blocks)))
        used_s += cost_s * rounds[-1]

    monkeypatch.setattr(drive._estimation, "take", work_off)
    monkeypatch.setattr(time, "thread_time", lambda: used_s)
    for _ in range(200):
        drive.reader.queue.put(driver.source.next_block(10))
    drive.work()
    assert rounds == [500] and drive.starts
    while drive.work():
        pass
    assert all(n * cost_s == pytest.approx(drive_module._ROUND_S, abs=10 * cost_s) for n in rounds[1:-1])
    assert not drive.starts and drive._estimation.worked_s == 0.0
    cost_s = 1e-5
    for _ in range(200):
        drive.reader.queue.put(driver.source.next_block(10))
    while drive.work():
        pass
    assert max(rounds[-4:]) == 500  # what took long once does not count


class One:
    """A daemon with one drive, for the metrics."""

    version, started, archive, sinks = "0", 0.0, None, ()

    def __init__(self, drive: DriveRuntime) -> None:
        self.drives = {"axis1": drive}

    def problems(self) -> list[str]:
        return []

    def stopping(self) -> bool:
        return False
