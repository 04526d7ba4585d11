"""The threads that turn the drives' pipelines: one for all of them, and as many as the machine has room for beside it
for those that take long.

The thread that all share reads the lines that need no thread of their own (`daemon/lines/ports.py`), is woken by the
blocks of the others, which come some 25 times a second, and takes what has queued up for each drive in one go: eight
drives cost 20 % less so than with a thread each. A drive whose turn takes long (a plant that is compiled, a start or a
jump filtered again, a slow engine) keeps the thread that it is in, and another goes on with the rest. Compiled code and
CasADi release the interpreter, and plain Python gives it up every few milliseconds, so that the others do turn
meanwhile.

The next turns of such a drive, and the first of each, wait for a place: one after the other, while their samples queue
up. (With a thread each, 64 drives that started had the interpreter by turns: of these threads each waited for all
others, the lines were not read for seconds, and a third of the drives had had no turn after a minute.)
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence

from servo_daemon.daemon.lines.ports import Ports
from servo_daemon.daemon.load import LATE_S, Backlog
from servo_daemon.daemon.slot import DriveSlot, Turn

#: With several drives the shared thread waits so long for the others' blocks once one has come, s: fewer turns. Not
#: beside a drive that takes long: then it waits for the interpreter often enough.
_GATHER_S = 0.015
#: Without any block drives are turned all the same, to see that one has fallen silent and to carry out requests, s.
_IDLE_TURN_S = 0.1
#: A drive without a long turn for so long goes back to the others, s.
_QUICK_S = 1.0
#: A drive keeps its place for so long while it has samples, s: most of a start. Then it is the next one's.
_SLICE_S = 0.5
#: Where none of those that take long has samples, it is looked again after so long, s.
_LOOK_S = 0.01


def _places() -> int:
    """How many drives may take long at once: one core is left for all others."""
    return max(1, (os.cpu_count() or 1) - 1)


class Workers:
    """The threads that turn all drives. `start` once.

    Args:
        stop: set when they are to end.
        ports: that the shared thread reads; None: there are none.
        places: how many drives may take long at once, but for those whose turn was not known to.

    Attributes:
        slots: may be exchanged while they work.
    """

    def __init__(self, stop: threading.Event, ports: Ports | None = None, places: int | None = None) -> None:
        self.slots: Sequence[DriveSlot] = ()
        self._stop, self._wake, self._lock = stop, threading.Event(), threading.Lock()
        self._ports = Ports() if ports is None else ports
        self._turn: Turn | None = None
        self._shared: threading.Thread | None = None
        self._threads: list[threading.Thread] = []
        self._last: DriveSlot | None = None  # that the shared thread turned
        self._places = _places() if places is None else places
        self._waiting: deque[DriveSlot] = deque()  # those that take long and have no place; under the lock
        self._backlog = Backlog()  # under the lock
        self._taken = 0  # places, and threads in a turn that was not known to be long; under the lock
        self._under_way: set[Turn] = set()  # of those that have a place; under the lock

    def start(self, slots: Sequence[DriveSlot]) -> None:
        self.slots = slots
        self._replace_shared()

    @property
    def started(self) -> bool:
        return self._shared is not None

    def is_alive(self) -> bool:
        """Whether a thread is at work still."""
        return any(thread.is_alive() for thread in self._threads)

    def join(self, timeout_s: float) -> None:
        """Wait for the end of all, at most so long."""
        deadline = time.monotonic() + timeout_s
        for thread in list(self._threads):
            thread.join(max(0.0, deadline - time.monotonic()))

    def call(self) -> None:
        """There is work. Any thread; the readers' blocks call often enough to see a turn that takes long."""
        self._wake.set()
        self.look()

    def look(self) -> None:
        """Where a turn takes long, let another thread go on with the other drives; where one that has a place only
        waits for something, give its place away meanwhile. Any thread."""
        self._see_who_gets_on()
        if any(turn.is_stuck for turn in tuple(self._under_way)):
            self._give_away_places()
        turn = self._turn
        if turn is None or not turn.is_long:
            return
        if len(self.slots) == 1 and not len(self._ports):  # nobody waits
            return
        with self._lock:
            if self._turn is not turn or self._stop.is_set():
                return
            turn.slot.takes_long, self._turn = True, None
            self._taken += 1
            self._under_way.add(turn)
            self._replace_shared()

    def _see_who_gets_on(self) -> None:
        """Neither a turn that gets little of the processor has stopped, nor have those that wait for its place."""
        if not self._under_way:
            return
        now = time.monotonic()
        with self._lock:
            on = [turn.slot for turn in self._under_way if turn.gets_on()]
            for slot in (*on, *self._waiting) if on else ():
                slot.seen = now

    # -- the shared thread -----------------------------------------------------------------------------------

    def _replace_shared(self) -> None:
        self._shared = self._begun(threading.Thread(target=self._work_for_all, name="pipeline", daemon=True))

    def _begun(self, thread: threading.Thread) -> threading.Thread:
        self._threads = [other for other in self._threads if other.is_alive()]
        self._threads.append(thread)
        thread.start()
        return thread

    def _work_for_all(self) -> None:
        while not self._stop.is_set():
            called = self._wake.wait(self._ports.wait_s(_IDLE_TURN_S))
            if called and len(self.slots) > len(self._ports) + 1 and not any(s.takes_long for s in self.slots):
                self._stop.wait(_GATHER_S)
            self._ports.read()
            self._wake.clear()
            self._tell_who_is_held_up(self.slots)
            for slot in self._round():
                self._ports.read()  # once more, where the round takes longer than from one reading to the next
                if slot.takes_long:
                    self._tell_if_it_waits(slot)
                elif slot.is_to_start and len(self.slots) > 1:
                    self._give_place(slot)
                elif not self._is_back_after(slot):
                    self._work_for_long(slot)
                    return
        with self._lock:
            waiting = tuple(self._waiting)
        for slot in self.slots:
            if not slot.takes_long or slot in waiting:  # the others are offered by the threads that turn them
                slot.offer()

    def _round(self) -> Iterator[DriveSlot]:
        """All drives, from the one on that is next: a thread that replaces another begins where that one was."""
        slots = self.slots
        first = slots.index(self._last) + 1 if self._last in slots else 0
        for slot in (*slots[first:], *slots[:first]):
            self._last = slot
            yield slot

    def _is_back_after(self, slot: DriveSlot) -> bool:
        """Turn a drive. Returns whether this is the shared thread still."""
        self._turn = turn = Turn.begun(slot)
        slot.turn()
        with self._lock:
            if slot.takes_long:
                self._end(turn)
            else:
                self._turn = None
            return not slot.takes_long

    def _tell_who_is_held_up(self, slots: Sequence[DriveSlot]) -> None:
        """Others start and are late, which takes of what these have; or all together catch up."""
        now = time.monotonic()
        waited_s = {slot: slot.runtime.reader.queue.waited_s(now) for slot in self.slots}
        starting = {slot for slot, late_s in waited_s.items() if slot.runtime.starts and late_s > LATE_S}
        with self._lock:
            self._backlog.see(sum(waited_s.values()), now)
            falls = self._backlog.falls
        for slot in slots:
            slot.runtime.held_up = falls or bool(starting - {slot})

    def _tell_if_it_waits(self, slot: DriveSlot) -> None:
        with self._lock:
            if slot in self._waiting:
                slot.runtime.tell_waiting(self._waiting.index(slot))

    def _give_place(self, slot: DriveSlot) -> None:
        """The drive's next turn will take long: as soon as there is a place for it."""
        with self._lock:
            slot.takes_long = True
            self._waiting.append(slot)
            self._fill_places()

    def _fill_places(self) -> None:
        """Threads for those that wait, as far as there are places. Under the lock."""
        if self._taken < self._places and self._waiting and not self._stop.is_set():
            self._taken += 1
            self._begun(threading.Thread(target=self._work_for_long, name="pipeline-long", daemon=True))

    # -- a thread for those that take long -------------------------------------------------------------------

    def _work_for_long(self, slot: DriveSlot | None = None) -> None:
        """Those that take long, one after the other, until there are none.

        Args:
            slot: which has just had a long turn in this thread.
        """
        if slot is not None:
            slot.last_long = slot.turned
        while self._goes_on_after(slot):
            slot = self._next()
            if slot is None:
                self._stop.wait(_LOOK_S)
            else:
                threading.current_thread().name = f"pipeline-{slot.runtime.name}"
                self._work_for(slot)

    def _goes_on_after(self, slot: DriveSlot | None) -> bool:
        """Put back the drive that has had its turns; whether this thread goes on."""
        if slot is not None and self._stop.is_set() and not slot.left.is_set():
            slot.offer()
        with self._lock:
            if slot is not None and not slot.left.is_set():
                slot.takes_long = slot.turned - slot.last_long < _QUICK_S
                if slot.takes_long:
                    self._waiting.append(slot)
                else:
                    self._wake.set()
            now = time.monotonic()
            for other in self._waiting:  # their turn comes
                other.seen = now
            goes_on = self._taken <= min(self._places, len(self._waiting) + len(self._under_way))
            goes_on &= not self._stop.is_set()
            self._taken -= not goes_on
            return goes_on

    def _next(self) -> DriveSlot | None:
        """The first of those that wait and have something to do; None: none has."""
        idle_since = time.monotonic() - _IDLE_TURN_S
        with self._lock:
            for slot in self._waiting:
                if slot.wake.is_set() or slot.turned < idle_since:
                    self._waiting.remove(slot)
                    return slot
        return None

    def _work_for(self, slot: DriveSlot) -> None:
        """Its turns while it has samples, for a while."""
        began = time.monotonic()
        self._tell_who_is_held_up([slot])
        while not self._stop.is_set():
            slot.wake.clear()
            turn = Turn.begun(slot)
            with self._lock:
                self._under_way.add(turn)
            slot.turn()
            with self._lock:
                self._end(turn)
            if turn.is_long:
                slot.last_long = slot.turned
            if not slot.wake.is_set() or slot.turned - began >= _SLICE_S:
                return

    def _end(self, turn: Turn) -> None:
        """A turn that took long is over: where its place was given away this thread takes one again. Under the lock."""
        self._taken += turn not in self._under_way
        self._under_way.discard(turn)

    def _give_away_places(self) -> None:
        with self._lock:
            for turn in [turn for turn in self._under_way if turn.is_stuck]:
                self._under_way.discard(turn)
                self._taken -= 1
                self._fill_places()
