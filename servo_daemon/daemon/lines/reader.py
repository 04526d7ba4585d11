"""One reader thread a drive: opens the driver, moves blocks into a bounded queue, reconnects with back-off.

A line whose bytes wait in the system's buffer is read by the thread that reads all such lines
(`daemon/lines/ports.py`), and its own sleeps meanwhile. Else the thread does nothing else, so that a slow moment
anywhere else never makes a serial buffer overflow. Every sample that is lost here is counted; nothing is dropped
silently.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from drivers.base import Driver
from servo_daemon.daemon.lines.ports import Ports
from servo_daemon.errors import (
    DriverConfigError,
    DriverDisconnectedError,
    DriverUnavailableError,
    EndOfStreamError,
)
from servo_daemon.published.snapshot import Connection
from servo_daemon.samples import Quality, SampleBlock

log = logging.getLogger(__name__)

#: How long a read may block, s: bounds how long a stop takes.
READ_TIMEOUT_S = 0.2
#: Open and connected, but no sample for this long: silent, s. Twice the period of description frames, without which
#: a fresh attachment has nothing to show.
SILENT_AFTER_S = 2.0
#: First and longest pause between attempts to open, s; each failure doubles it.
_BACKOFF_FIRST_S, _BACKOFF_LONGEST_S = 0.25, 5.0
#: Samples the queue holds: 20 s at 10 kHz, 40 MB at worst.
QUEUE_SAMPLES = 200_000
#: Where the source can wait no more are read than so many ahead of the pipeline: a tenth of a second of work. Looked at
#: again after so long, s.
_AHEAD_SAMPLES, _LOOK_AGAIN_S = 10_000, 0.01


class BlockQueue:
    """Blocks between one producer and one consumer, bounded in samples; the oldest go when it is full."""

    def __init__(self, capacity: int = QUEUE_SAMPLES) -> None:
        self._capacity = capacity
        self._lock = threading.Lock()
        self._blocks: deque[tuple[float, SampleBlock]] = deque()
        self.samples = 0
        self.dropped = 0

    def put(self, block: SampleBlock, arrived_s: float | None = None) -> None:
        """Append a block; where that is too much the oldest are dropped, counted, and the hole is flagged.

        Args:
            arrived_s: host monotonic; None: now.
        """
        with self._lock:
            self._blocks.append((time.monotonic() if arrived_s is None else arrived_s, block))
            self.samples += len(block)
            self._drop_while(lambda _: self.samples > self._capacity)

    def take(self, most: float = math.inf) -> list[SampleBlock]:
        """What waits, oldest first: whole blocks, no more of them than make this many samples."""
        taken: list[SampleBlock] = []
        with self._lock:
            left = most
            while self._blocks and left > 0:
                taken.append(self._blocks.popleft()[1])
                left -= len(taken[-1])
            self.samples -= sum(map(len, taken))
        return taken

    def waited_s(self, now_s: float) -> float:
        """How long the oldest block has waited; 0: none does."""
        with self._lock:
            return now_s - self._blocks[0][0] if self._blocks else 0.0

    def drop_before(self, then_s: float) -> None:
        """Drop what arrived before then; counted, and the hole is flagged. The last block stays."""
        with self._lock:
            self._drop_while(lambda arrived_s: arrived_s < then_s)

    def _drop_while(self, too_old: Callable[[float], bool]) -> None:
        before = self.dropped
        while len(self._blocks) > 1 and too_old(self._blocks[0][0]):
            _, oldest = self._blocks.popleft()
            self.samples -= len(oldest)
            self.dropped += len(oldest)
        if self.dropped > before:
            arrived_s, first = self._blocks[0]
            self._blocks[0] = arrived_s, _after_a_gap(first)


def _after_a_gap(block: SampleBlock) -> SampleBlock:
    quality = block.quality.copy()
    quality[0] |= Quality.GAP_BEFORE
    return replace(block, quality=quality)


@dataclass(frozen=True, slots=True)
class Link:
    """State of the line to a drive, replaced as a whole by the reader thread."""

    connection: Connection
    reason: str | None
    changed: float  # host monotonic, s


class Reader:
    """The reader thread of one drive.

    Args:
        driver: closed; the thread opens and closes it.
        wake: called after each block and each change of the line, from the reader's thread.
        report: called with (kind, message) when the line goes down or comes up, from the reader's thread.
        ports: that read lines in turn; None: its own thread reads.
    """

    def __init__(
        self,
        driver: Driver,
        wake: Callable[[], None],
        report: Callable[[str, str], None],
        ports: Ports | None = None,
    ) -> None:
        self.driver = driver
        self.queue = BlockQueue()
        self.reconnects = 0
        self.last_sample: float | None = None  # host monotonic, s
        self._looked_s = self._empty_s = 0.0  # the line was last read, and found to have nothing; host monotonic
        self._wake, self._report, self._ports = wake, report, ports
        self._released = threading.Event()  # the ports do not read this line any more
        self._error: Exception | None = None  # why they do not
        self._stop = threading.Event()
        self._was_open = False  # ever
        self._brought = False  # samples came in this attempt
        self._barren = False  # the last attachment brought none (yet)
        self._said_up = self._complained = False
        self._wait_first_s = 0.0
        self._link = Link("connecting", "not opened yet", time.monotonic())
        self._thread = threading.Thread(target=self._run, name=f"reader-{driver.name}", daemon=True)

    def start(self, after_s: float = 0.0) -> None:
        """
        Args:
            after_s: the device is opened so much later.
        """
        self._wait_first_s = after_s
        self._thread.start()

    def request_stop(self) -> None:
        """Ask the thread to end without waiting for it."""
        self._stop.set()
        self._released.set()

    def stop(self, timeout_s: float = 1.0) -> None:
        """Ask the thread to end and wait for it at most this long; idempotent."""
        self.request_stop()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        if self._thread.is_alive():
            log.warning("drive %s: reader did not end in %.1f s", self.driver.name, timeout_s)

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    @property
    def link(self) -> Link:
        """State of the line: an open one is connected from its first sample on, with what its driver remarks on, and
        silent when none come. (Where this process gets no time to read, that there are none is not known.)"""
        link, last = self._link, self.last_sample
        if link.connection != "connected":
            return link
        fresh = last is not None and last >= link.changed  # since it was opened
        before = last if last is not None and fresh else link.changed
        since = time.monotonic() - before
        if since > SILENT_AFTER_S and self._empty_s - before > SILENT_AFTER_S:
            return Link("silent", f"open, but no samples for {since:.1f} s; {self.driver.silence}", link.changed)
        if fresh:
            return replace(link, reason=self.driver.remark)
        return Link("connecting", "open, waiting for the first samples", link.changed)

    def _run(self) -> None:
        pause = _BACKOFF_FIRST_S
        try:
            self._stop.wait(self._wait_first_s)
            while not self._stop.is_set():
                self._brought = False
                error = self._serve()
                if self._brought:
                    pause = _BACKOFF_FIRST_S
                if error is None:
                    return
                self._complain(error)
                self._set(
                    "down" if self._was_open else "connecting", f"{self._text(error)}; next attempt in {pause:.2g} s"
                )
                self._stop.wait(pause)
                pause = min(2 * pause, _BACKOFF_LONGEST_S)
        finally:
            self.driver.close()

    def _serve(self) -> Exception | None:
        """Open and read until something happens. Returns why to try again, or None to end the thread."""
        try:
            self.driver.open()
            self._opened()
            if self._ports is not None and self.driver.is_buffered:
                self._be_read(self._ports)
            while not self._stop.is_set():
                if self.driver.can_wait and self.queue.samples > _AHEAD_SAMPLES:
                    self._stop.wait(_LOOK_AGAIN_S)
                    continue
                self._take(self.driver.read(READ_TIMEOUT_S))
        except EndOfStreamError as end:
            self._set("ended", self._text(end))
            self._report("ended", self._text(end))
            return None
        except (DriverUnavailableError, DriverDisconnectedError) as error:
            self.driver.close()
            return error
        except DriverConfigError as error:
            self._set("down", self._text(error))
            self._report("misconfigured", self._text(error))
            return None
        except Exception as error:  # a driver's bug must not end the drive's life
            if self._brought or not self._complained:
                log.exception("drive %s: driver failed", self.driver.name)
            self.driver.close()
            return error
        return None

    def _be_read(self, ports: Ports) -> None:
        """Sleep while the ports read this line, until something happens to it or the thread is to end.

        Raises:
            Exception: as `read` of the driver.
        """
        self._released.clear()
        self._error = None
        if self._stop.is_set():
            return
        ports.add(self)
        self._released.wait()
        ports.remove(self)
        if self._error is not None:
            raise self._error

    def poll(self) -> bool:
        """Take what has arrived, if something has, without waiting. One thread at a time. Returns whether it may be
        called again; where not, the line's own thread sees to it."""
        try:
            block = self.driver.read(0.0)
        except Exception as error:
            self._error = error
            self._released.set()
            return False
        self._take(block, since_s=self._looked_s)
        return True

    def _opened(self) -> None:
        self._set("connected", None)
        self._looked_s = time.monotonic()
        self.reconnects += self._was_open
        # A device that opens and fails again and again without a sample is not back: its first sample says so.
        if not self._barren:
            self._say_up()
        self._was_open = self._barren = True

    def _take(self, block: SampleBlock | None, since_s: float | None = None) -> None:
        """What a reading has brought, None: nothing; the first of it may have waited in the line since then."""
        self._looked_s = time.monotonic()
        if block is None:
            self._empty_s = self._looked_s
            return
        self.last_sample = self._looked_s
        self.queue.put(block, self.last_sample if since_s is None else since_s)
        self._brought, self._barren = True, False
        self._wake()
        if not self._said_up:
            self._say_up()

    def _say_up(self) -> None:
        self._said_up, self._complained = True, False
        self._report("connected", "device is back" if self._was_open else "device opened")

    def _complain(self, error: Exception) -> None:
        """Once for each time that the line goes down."""
        if self._complained:
            return
        self._complained, self._said_up = True, False
        self._report("disconnected" if self._was_open else "unavailable", self._text(error))

    def _text(self, error: Exception) -> str:
        """In words, without the drive's name: whoever shows it names the drive."""
        return (str(error) or type(error).__name__).removeprefix(f"drive {self.driver.name}: ")

    def _set(self, connection: Connection, reason: str | None) -> None:
        self._link = Link(connection, reason, time.monotonic())
        self._wake()
