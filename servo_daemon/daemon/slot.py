"""One drive among the threads that turn the drives (`daemon/worker.py`), and a turn of it that is under way."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from servo_daemon.daemon.drive import DriveRuntime

#: A turn beyond this is long, s of CPU time: with `daemon._WATCH_S` others wait for 35 ms at most. (By the wall clock
#: every turn is long where other programs, or threads of this one, have the processor; then all drives had a thread
#: each, which waited for each other.) One that waits for something (a compiler, a lock) is long after so long, s.
LONG_TURN_S, LONG_WAIT_S = 0.015, 1.0
#: A turn gets on where it has used so much more of the processor, s; where that takes longer than `LONG_WAIT_S`, it
#: waits for something. (A share of 10 % since it began, before: beside twenty busy programs no turn has that.)
_STEP_S = 0.005
#: A drive that has not turned for this long is a problem the API reports, s; a turn that has used as much of the
#: processor and is not over, too.
STUCK_S = 5.0


class DriveSlot:
    """One drive among the threads.

    Args:
        make: the drive, given what is called when there is work for it.
        wake_all: called as well.

    Attributes:
        takes_long: the shared thread does not turn it.
        turned: when it last did, host monotonic, s; `last_long` when that last took long.
        seen: when it last turned, got on with a turn, or waited while another drive did.
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
        self.takes_long = False
        self.turned = self.seen = self.last_long = self._next_save = time.monotonic()
        self.has_worked = self._leaving = False
        self.left = threading.Event()
        self.runtime = make(self.call)

    def call(self) -> None:
        """There is work. Any thread."""
        self.wake.set()
        self._wake_all()

    @property
    def is_to_start(self) -> bool:
        """Its first samples are there: an estimator has to be made for them."""
        return not self.has_worked and self.runtime.reader.queue.samples > 0

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
        self.turned = self.seen = time.monotonic()
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
        return self.seen >= then_s or self.runtime.preparing

    @property
    def problem(self) -> str | None:
        """What is wrong with it, in words."""
        since_s = time.monotonic() - self.seen
        if since_s <= STUCK_S or self.runtime.preparing:
            return None
        return f"drive {self.runtime.name}: the pipeline has not turned for {since_s:.0f} s"


@dataclass(slots=True, eq=False)
class Turn:
    """Under way.

    Attributes:
        clock: the CPU time of its thread; None: this system has none that others can read (macOS, Windows).
        began_s, cpu_began_s: host monotonic, and CPU time.
        counted_s: CPU time that it had used when it was last found to get on; `on_s` that moment.
    """

    slot: DriveSlot
    clock: int | None
    began_s: float
    cpu_began_s: float
    on_s: float
    counted_s: float = 0.0

    @classmethod
    def begun(cls, slot: DriveSlot) -> Turn:
        """A turn of this slot that begins now in this thread."""
        clock = time.pthread_getcpuclockid(threading.get_ident()) if hasattr(time, "pthread_getcpuclockid") else None
        now = time.monotonic()
        return cls(slot, clock, now, 0.0 if clock is None else time.clock_gettime(clock), now)

    @property
    def is_long(self) -> bool:
        """Any thread, while that of the turn lives."""
        waited = time.monotonic() - self.began_s
        if waited < LONG_TURN_S:
            return False
        if self.clock is None or self.slot.runtime.preparing or waited >= LONG_WAIT_S:
            return True
        return self.used_s >= LONG_TURN_S

    @property
    def used_s(self) -> float:
        """CPU time so far; 0 where it is not known. Any thread, while that of the turn lives."""
        return 0.0 if self.clock is None else time.clock_gettime(self.clock) - self.cpu_began_s

    def gets_on(self) -> bool:
        """Whether it has used the processor since this last was so: where others have it, a second of work takes many
        by the clock. Not where it has used so much that it will never end."""
        used_s = self.used_s
        if used_s < self.counted_s + _STEP_S:
            return False
        self.counted_s, self.on_s = used_s, time.monotonic()
        return used_s < STUCK_S

    @property
    def is_stuck(self) -> bool:
        """It waits for something else than the processor: a compiler, a lock."""
        return time.monotonic() - self.on_s >= LONG_WAIT_S
