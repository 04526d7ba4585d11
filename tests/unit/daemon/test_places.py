"""Drives whose turns take long: how many have theirs at once, who waits, what is said of it. Threads of the workers,
drives of the test's own that run as long as it likes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from servo_daemon.daemon import slot as slot_module
from servo_daemon.daemon.load import LATE_S, PATIENCE_S, LoadWatch
from servo_daemon.daemon.slot import DriveSlot
from servo_daemon.daemon.worker import Workers
from tests.unit.daemon.test_load import Line

SOON_S = 10.0


class Starting:
    """A drive whose only turn with samples lasts until the test lets it go."""

    def __init__(self, name: str, inside: list[str], wake: Callable[[], None]) -> None:
        self.name, self._inside, self._wake = name, inside, wake
        self.reader = SimpleNamespace(queue=SimpleNamespace(samples=1, waited_s=lambda now_s: 0.0))
        self.go_on, self.begun = threading.Event(), threading.Event()
        self.waited_behind: list[int] = []
        self.offered = 0
        self.preparing = self.held_up = False
        self.starts = True

    def work(self) -> bool:
        if not self.reader.queue.samples:
            return False
        self._inside.append(self.name)
        self.begun.set()
        assert self.go_on.wait(SOON_S)
        self._inside.remove(self.name)
        self.reader.queue.samples = 0
        return True

    def tell_waiting(self, before: int) -> None:
        self.waited_behind.append(before)

    def offer_state(self) -> None:
        self.offered += 1


@pytest.fixture
def begun(request: pytest.FixtureRequest) -> Callable[..., tuple[Workers, list[Any], list[str]]]:
    def make(names: str, places: int) -> tuple[Workers, list[Any], list[str]]:
        stop, inside = threading.Event(), []
        workers = Workers(stop, places=places)
        slots = [
            DriveSlot(lambda wake, n=n: Starting(n, inside, wake), workers.call, 60.0, lambda: None)  # type: ignore[misc,return-value]
            for n in names
        ]

        def end() -> None:
            stop.set()
            for slot in slots:
                slot.runtime.go_on.set()  # type: ignore[attr-defined]
                slot.call()
            workers.join(SOON_S)
            assert not workers.is_alive()

        request.addfinalizer(end)
        workers.start(slots)
        workers.call()
        return workers, slots, inside

    return make


def until(condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_drives_start_as_many_at_once_as_there_are_places_in_the_order_in_which_they_came(
    begun: Callable[..., tuple[Workers, list[Any], list[str]]],
) -> None:
    """The others wait, know how many are before them, and are not stuck."""
    workers, slots, inside = begun("abcd", places=1)
    order = []
    for _ in slots:
        until(lambda: len(inside) == 1)
        order.append(inside[0])
        workers.call()
        until(lambda: all(s.runtime.waited_behind for s in slots if s.runtime.name not in order))
        assert len(inside) == 1
        now_there = next(s.runtime for s in slots if s.runtime.name == inside[0])
        now_there.go_on.set()
        until(lambda there=now_there: not there.reader.queue.samples)
    assert order == list("abcd")
    assert [s.runtime.waited_behind[0] for s in slots[1:]] == [0, 1, 2]
    assert all(s.problem is None for s in slots)


def test_a_turn_that_gets_little_of_the_processor_has_not_stopped(
    begun: Callable[..., tuple[Workers, list[Any], list[str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside six busy programs a start took seven seconds by the clock, and the service manager heard nothing."""
    workers, slots, inside = begun("ab", places=1)
    until(lambda: inside == ["a"] and slots[1].runtime.waited_behind)
    found = []
    for used_s in (0.1, 0.1, 0.11, slot_module.STUCK_S + 1.0):
        monkeypatch.setattr(slot_module.Turn, "used_s", used_s)
        for slot in slots:
            slot.seen = -1.0
        workers.look()
        found.append([slot.seen > 0.0 for slot in slots])
    assert found == [[True, True], [False, False], [True, True], [False, False]]


def test_a_turn_that_only_waits_gives_its_place_to_the_next(
    begun: Callable[..., tuple[Workers, list[Any], list[str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compiler that hangs must not keep the other drives from starting."""
    monkeypatch.setattr(slot_module, "LONG_WAIT_S", 0.05)
    workers, slots, inside = begun("abc", places=1)

    def both() -> bool:
        workers.look()  # as the daemon's watcher does
        return len(inside) >= 2

    until(both)
    assert sorted(inside)[:2] == ["a", "b"] and not slots[0].runtime.go_on.is_set()


def test_drives_are_held_up_by_others_that_are_late_from_their_start_wherever_those_have_their_turns() -> None:
    """Between two looks back a start is the shared thread's, and may be far behind."""
    slots: list[Any] = [
        DriveSlot(lambda wake, n=n: Starting(n, [], wake), lambda: None, 60.0, lambda: None)  # type: ignore[misc,return-value]
        for n in "abc"
    ]
    workers = Workers(threading.Event())
    workers.slots = slots
    found = []
    for starts, waited_s in (((1, 0, 0), LATE_S + 1.0), ((1, 0, 0), 0.1), ((1, 1, 0), LATE_S + 1.0), ((0, 0, 0), 9.0)):
        for slot, its in zip(slots, starts, strict=True):
            slot.runtime.starts = bool(its)
            slot.runtime.reader.queue.waited_s = lambda _, late_s=waited_s: late_s
        workers._tell_who_is_held_up(slots)
        found.append([slot.runtime.held_up for slot in slots])
    assert found == [[False, True, True], [False] * 3, [True] * 3, [False] * 3]


def test_what_a_drive_that_waits_knows_is_kept_at_the_end(
    begun: Callable[..., tuple[Workers, list[Any], list[str]]],
) -> None:
    workers, slots, inside = begun("ab", places=1)
    until(lambda: inside == ["a"] and slots[1].runtime.waited_behind)
    workers._stop.set()
    workers.call()
    until(lambda: slots[1].runtime.offered == 1)
    assert slots[0].runtime.offered == 0  # it is in its turn still
    slots[0].runtime.go_on.set()
    until(lambda: slots[0].runtime.offered)


def test_a_drive_that_waits_for_its_start_loses_nothing_and_says_so() -> None:
    """However long: it is not too slow, it has not been asked."""
    line = Line()
    line.run(20.0, blocks_per_s=1e-3)
    assert [kind for kind, _, _ in line.watch.wait(line.queue, line.now_s, 7)] == ["behind"]
    assert line.watch.wait(line.queue, line.now_s, 6) == [] and line.watch.behind
    for k in range(200):  # one late turn after another, for longer than one that is too slow is given
        now = line.now_s + k * PATIENCE_S / 50
        line.watch.relieve(line.queue, now, used_s=now, held_up=True)
        assert line.queue.waited_s(now) > LATE_S
        line.queue.take(1)
    assert line.queue.dropped == 0 and not line.watch.overloaded
    assert LoadWatch().wait(Line().queue, 0.0, 3) == []  # nothing waits
