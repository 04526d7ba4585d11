"""Lines that one thread reads in turn, without waiting for any.

What arrives on a serial port waits in the system's buffer (64 kB, some seconds of a line). So many ports need no thread
each that is woken for each: at 32 drives half of what they cost was waking threads and handing over. The thread that
turns the drives reads them all, decodes, and goes on to the turns; each port's own thread only opens it, and sleeps.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Protocol

#: From one reading to the next, s: with few drives as `drivers.serial.listener` has it, with many as long as they need
#: for their turns (0.5 ms of each in 40 ms), so that the next one gathers more of each.
_EVERY_S, _EVERY_OF_EACH_S = 0.04, 0.9e-3
#: The same while nobody waits for what comes of it, s: a tick (decision 87); who asks less often has something new each
#: time anyway. Who has waited does for so long after it, s.
UNASKED_EVERY_S, ASKED_FOR_S = 0.1, 3.0
#: Nor does reading take more than one part in this many of the time: of the processor's, for where other programs or
#: threads have it, lines that are read more seldom run over.
_EVERY_OF_READING = 3.0


class Line(Protocol):
    """One that can be read without waiting."""

    def poll(self) -> bool:
        """Take what has arrived. Returns whether the line goes on; one that does not is not asked again."""


class Ports:
    """The lines that are read in turn: added and removed by any thread, read by one at a time.

    Args:
        clock, cpu_clock: host monotonic, and the CPU time of the thread that reads, s.
    """

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, cpu_clock: Callable[[], float] = time.thread_time
    ) -> None:
        self._clock, self._cpu_clock = clock, cpu_clock
        self._lines: tuple[Line, ...] = ()  # replaced as a whole, under the lock
        self._lock = threading.Lock()
        self._due_s, self._asked_s = 0.0, -math.inf
        self._asks_s: dict[str, float] = {}  # the last, of each drive

    def __len__(self) -> int:
        return len(self._lines)

    def add(self, line: Line) -> None:
        """From now on this line is read."""
        with self._lock:
            self._lines = (*self._lines, line)

    def remove(self, line: Line) -> None:
        """It is read no more, but for a reading that is under way; does nothing where it was not read."""
        with self._lock:
            self._lines = tuple(other for other in self._lines if other is not line)

    def ask(self, drive: str) -> None:
        """A client asks for a drive's newest samples; it waits for them if it did so a tick ago, too. Any thread."""
        before_s, now_s = self._asks_s.get(drive, -math.inf), self._clock()
        self._asks_s[drive] = now_s
        if now_s - before_s < UNASKED_EVERY_S:
            self._asked_s = now_s

    def wait_s(self, longest_s: float) -> float:
        """How long until they are to be read, at most so long."""
        return min(max(self._due_s - self._clock(), 0.0), longest_s) if self._lines else longest_s

    def read(self) -> None:
        """Read all, if it is time to."""
        began_s = self._clock()
        if began_s < self._due_s:
            return
        lines, cpu_began_s = self._lines, self._cpu_clock()
        for line in lines:
            if not line.poll():
                self.remove(line)
        took_s = self._cpu_clock() - cpu_began_s
        every_s = _EVERY_S if began_s - self._asked_s < ASKED_FOR_S else UNASKED_EVERY_S
        self._due_s = began_s + max(every_s, _EVERY_OF_EACH_S * len(lines), _EVERY_OF_READING * took_s)
