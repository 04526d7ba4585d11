"""The threads that turn the drives' pipelines: one for all of them, and one more for each drive that takes long.

The thread that all share reads the lines that need no thread of their own (`daemon/lines/ports.py`), is woken by the
blocks of the others, which come some 25 times a second, and takes what has queued up for each drive in one go: eight
drives cost 20 % less so than with a thread each. A drive whose turn takes long (a plant that is compiled, a start or a
jump filtered again, a slow engine) keeps the thread that it is in, and another goes on with the rest. Compiled code and
CasADi release the interpreter, and plain Python gives it up every few milliseconds, so that the others do turn
meanwhile.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from servo_daemon.daemon.drive import DriveRuntime
from servo_daemon.daemon.lines.ports import Ports

#: With several drives the shared thread waits so long for the others' blocks once one has come, s: fewer turns. Not
#: beside a drive that takes long: then it waits for the interpreter often enough.
_GATHER_S = 0.015
#: Without any block drives are turned all the same, to see that one has fallen silent and to carry out requests, s.
_IDLE_TURN_S = 0.1
#: A turn beyond this is long, s of CPU time: with `daemon._WATCH_S` others wait for 35 ms at most. (By the wall clock
#: every turn is long where other programs, or threads of this one, have the processor; then all drives had a thread
#: each, which waited for each other.) One that waits for something (a compiler, a lock) is long after so long, s.
LONG_TURN_S, LONG_WAIT_S = 0.015, 1.0
#: A drive without a long turn for so long goes back to the others, s.
_QUICK_S = 1.0
#: A drive that has not turned for this long is a problem the API reports, s.
STUCK_S = 5.0


class DriveSlot:
    """One drive among the threads.

    Args:
        make: the drive, given what is called when there is work for it.
        wake_all: called as well.

    Attributes:
        owner: the thread that works for this drive alone; None: the shared one does.
        turned: when it last did, host monotonic, s.
        has_worked: samples have been worked off.
        left: the drive has gone, and what it knew is laid out to be saved.
    """

    def __init__(
        self,
        make: Callable[[Callable[[], None]], DriveRuntime],
        wake_all: Callable[[], None],
        save_interval_s: float,
        save: Callable[[], None],
    ) -> None:
        self.wake, self._wake_all = threading.Event(), wake_all
        self._save_interval_s, self._save = save_interval_s, save
        self.owner: threading.Thread | None = None
        self.turned = self._next_save = time.monotonic()
        self.has_worked = self._leaving = False
        self.left = threading.Event()
        self.runtime = make(self.call)

    def call(self) -> None:
        """There is work. Any thread."""
        self.wake.set()
        self._wake_all()

    def leave(self) -> None:
        """The drive is to go: its reader has ended. Any thread; `left` tells when what had come is worked off."""
        self._leaving = True
        self.call()

    def turn(self) -> None:
        """A round of the drive's work, and time and again what it knows laid out to be saved."""
        if self.left.is_set():
            return
        leaving = self._leaving  # looked at before: then everything that will come is in the queue
        self.has_worked |= self.runtime.work()
        self.turned = time.monotonic()
        if self.runtime.reader.queue.samples:
            self.call()
        elif leaving:
            self.offer()
            self.left.set()
            return
        if self.turned >= self._next_save:
            self._next_save = self.turned + self._save_interval_s
            self.offer()

    def offer(self) -> None:
        """The pipeline belongs to the thread that works for it; writing to a disk that may be slow does not."""
        self.runtime.offer_state()
        self._save()

    def has_turned_since(self, then_s: float) -> bool:
        """Whether it has turned, or makes an estimator, which may take ten seconds.

        Args:
            then_s: host monotonic.
        """
        return self.turned >= then_s or self.runtime.preparing

    @property
    def problem(self) -> str | None:
        """What is wrong with it, in words."""
        since_s = time.monotonic() - self.turned
        if since_s <= STUCK_S or self.runtime.preparing:
            return None
        return f"drive {self.runtime.name}: the pipeline has not turned for {since_s:.0f} s"


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """Under way.

    Attributes:
        clock: the CPU time of its thread; None: this system has none that others can read (macOS, Windows).
        began_s, cpu_began_s: host monotonic, and CPU time.
    """

    slot: DriveSlot
    clock: int | None
    began_s: float
    cpu_began_s: float

    @classmethod
    def begun(cls, slot: DriveSlot) -> _Turn:
        """In this thread, now."""
        clock = time.pthread_getcpuclockid(threading.get_ident()) if hasattr(time, "pthread_getcpuclockid") else None
        return cls(slot, clock, time.monotonic(), 0.0 if clock is None else time.clock_gettime(clock))

    @property
    def is_long(self) -> bool:
        """Any thread, while that of the turn lives."""
        waited = time.monotonic() - self.began_s
        if waited < LONG_TURN_S:
            return False
        if self.clock is None or self.slot.runtime.preparing or waited >= LONG_WAIT_S:
            return True
        return time.clock_gettime(self.clock) - self.cpu_began_s >= LONG_TURN_S


class Workers:
    """The threads that turn all drives. `start` once.

    Args:
        stop: set when they are to end.
        ports: that the shared thread reads; None: there are none.

    Attributes:
        slots: may be exchanged while they work.
    """

    def __init__(self, stop: threading.Event, ports: Ports | None = None) -> None:
        self.slots: Sequence[DriveSlot] = ()
        self._stop, self._wake, self._lock = stop, threading.Event(), threading.Lock()
        self._ports = Ports() if ports is None else ports
        self._turn: _Turn | None = None
        self._shared: threading.Thread | None = None
        self._threads: list[threading.Thread] = []

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
        """Where a turn takes long, let another thread go on with the other drives. Any thread."""
        turn = self._turn
        if turn is None or not turn.is_long:
            return
        if len(self.slots) == 1 and not len(self._ports):  # nobody waits
            return
        with self._lock:
            if self._turn is not turn or self._stop.is_set():
                return
            turn.slot.owner, self._turn = self._shared, None
            self._replace_shared()

    def _replace_shared(self) -> None:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        self._shared = threading.Thread(target=self._work_for_all, name="pipeline", daemon=True)
        self._threads.append(self._shared)
        self._shared.start()

    def _work_for_all(self) -> None:
        while not self._stop.is_set():
            called = self._wake.wait(self._ports.wait_s(_IDLE_TURN_S))
            if called and len(self.slots) > len(self._ports) + 1 and all(slot.owner is None for slot in self.slots):
                self._stop.wait(_GATHER_S)
            self._ports.read()
            self._wake.clear()
            for slot in self.slots:
                if slot.owner is None and not self._is_back_after(slot):
                    self._work_for(slot)
                    return
        for slot in self.slots:
            if slot.owner is None:
                slot.offer()

    def _is_back_after(self, slot: DriveSlot) -> bool:
        """Turn a drive. Returns whether this is the shared thread still."""
        self._turn = _Turn.begun(slot)
        slot.turn()
        with self._lock:
            self._turn = None if slot.owner is None else self._turn
            return slot.owner is None

    def _work_for(self, slot: DriveSlot) -> None:
        """Alone, until its turns are no longer long."""
        threading.current_thread().name = f"pipeline-{slot.runtime.name}"
        last_long = time.monotonic()
        while not self._stop.is_set() and not slot.left.is_set():
            slot.wake.wait(_IDLE_TURN_S)
            slot.wake.clear()
            turn = _Turn.begun(slot)
            slot.turn()
            if turn.is_long:
                last_long = slot.turned
            elif slot.turned - last_long >= _QUICK_S:
                slot.owner = None
                self._wake.set()
                return
        if not slot.left.is_set():
            slot.offer()
