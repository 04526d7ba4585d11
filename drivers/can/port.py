"""One python-can bus, shared by all the drives on it: one thread receives, each drive gets the frames it wants.

A serial or USB adapter cannot be opened twice (two readers would steal each other's frames), and receiving every frame
once for eight drives is eight times cheaper than once for each. The thread waits until something has arrived, lets a
few milliseconds of traffic gather, and drains it in one go; nothing runs in python-can's callbacks, which are known to
drop frames at 1 kHz. What has gathered becomes arrays once for all drives, sorted by drive, so that each drive's frames
are a slice of them.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import can

from drivers.base import DriverCounters
from drivers.can.decode import EXTENDED, FrameBatch, batch_of
from drivers.can.receive import Receiver, close_bus, open_bus
from servo_daemon.errors import DriverConfigError

#: How long the thread waits at most before it looks whether it shall stop.
SLICE_S = 0.1
#: A bus that takes no frame for so long has no other node or is broken.
SEND_S = 0.1
#: Frames waiting for a drive that does not read: eight seconds of a full bus. Beyond it the oldest go, and are counted.
INBOX_FRAMES = 65_536

#: In an error frame of SocketCAN's form (8 bytes, class bits in the identifier): CAN_ERR_BUSOFF, linux/can/error.h.
BUS_OFF = 0x40

Key = tuple[str, str]


@dataclass(slots=True, eq=False)
class Inbox:
    """Where one drive's frames wait. Owned by the port; guarded by its lock.

    Attributes:
        keys: identifiers wanted.
        counters: the drive's, for what is not delivered.
        batches: what has been received and not been taken, in the order of arrival.
        waiting: frames in them.
        sorted_out: this drive's of the messages being handed out now.
        prompt: every frame is handed on at once: the drive waits for answers.
    """

    keys: frozenset[int]
    counters: DriverCounters
    batches: deque[FrameBatch] = field(default_factory=deque)
    waiting: int = 0
    sorted_out: list[can.Message] = field(default_factory=list)
    prompt: bool = False

    def put(self, batch: FrameBatch) -> None:
        """Append; where that is too much, the oldest go and are counted."""
        self.batches.append(batch)
        self.waiting += len(batch)
        excess = self.waiting - INBOX_FRAMES
        if excess > 0:
            self.waiting -= excess
            self.count("inbox_dropped", excess)
            while excess >= len(self.batches[0]):
                excess -= len(self.batches.popleft())
            self.batches[0] = self.batches[0].slice(excess, len(self.batches[0]))

    def count(self, what: str, n: int = 1) -> None:
        self.counters.extra[what] = self.counters.extra.get(what, 0) + n


class CanPort:
    """An open bus and its receiving thread; made by `attach`, gone with its last drive."""

    _open: ClassVar[dict[Key, CanPort]] = {}
    _open_lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, key: Key, settings: Mapping[str, Any]) -> None:
        self._key, self._settings = key, dict(settings)
        self._bus = open_bus(settings)
        self._ready = threading.Condition()
        self._inboxes: list[Inbox] = []
        self._routes: dict[int, list[list[can.Message]]] = {}
        self._prompt = False
        self._stopping = False
        self._failure: str | None = None
        self._thread = threading.Thread(target=self._run, name=f"can-{key[1]}", daemon=True)
        self._thread.start()

    # ---- called by the drives

    @classmethod
    def attach(cls, settings: Mapping[str, Any], inbox: Inbox) -> CanPort:
        """The port with these settings, opened if no other drive has it open.

        Args:
            settings: keyword arguments of `can.Bus`, with interface and channel.

        Raises:
            DriverUnavailableError: the adapter cannot be opened now.
            DriverConfigError: it can never be with these settings, or is open with others.
        """
        key = (str(settings["interface"]), str(settings.get("channel")))
        with cls._open_lock:
            port = cls._open.get(key)
            if port is None or port._failure is not None:
                port = cls._open[key] = cls(key, settings)
            elif port._settings != dict(settings):
                raise DriverConfigError(f"{key[0]} {key[1]} is open for another drive with other settings")
            with port._ready:
                port._inboxes.append(inbox)
                port._reroute()
        return port

    def detach(self, inbox: Inbox) -> None:
        """Take a drive's inbox away; the last one closes the bus. Never raises."""
        with self._open_lock:
            with self._ready:
                if inbox in self._inboxes:
                    self._inboxes.remove(inbox)
                    self._reroute()
                self._stopping |= not self._inboxes
                self._ready.notify_all()
            if self._stopping:
                if self._open.get(self._key) is self:
                    del self._open[self._key]
                self._thread.join()

    def take(self, inbox: Inbox, timeout_s: float, closed: Callable[[], bool]) -> FrameBatch | None:
        """The oldest frames in an inbox, those that were received together, within `timeout_s`; None if there are none.

        Args:
            closed: tells whether the drive has been closed meanwhile, which ends the wait.

        Raises:
            ConnectionError: the bus is gone and nothing is left to be taken; the text says why.
        """
        with self._ready:
            if not inbox.batches:
                self._ready.wait_for(lambda: inbox.batches or self._failure is not None or closed(), timeout_s)
            if inbox.batches:
                batch = inbox.batches.popleft()
                inbox.waiting -= len(batch)
                return batch
            if self._failure is not None and not closed():
                raise ConnectionError(self._failure)
            return None

    def send(self, message: can.Message) -> None:
        """Put a frame on the bus.

        Raises:
            OSError: the adapter does not take it.
        """
        try:
            self._bus.send(message, timeout=SEND_S)
        except OSError:
            raise
        except Exception as error:  # every vendor's library has errors of its own
            raise OSError(f"{type(error).__name__}: {error}") from error

    def wake(self) -> None:
        """End the waits of `take` whose drive has been closed."""
        with self._ready:
            self._ready.notify_all()

    def _reroute(self) -> None:
        self._prompt = any(inbox.prompt for inbox in self._inboxes)
        self._routes = {}
        for inbox in self._inboxes:
            for key in inbox.keys:
                self._routes.setdefault(key, []).append(inbox.sorted_out)

    # ---- the receiving thread

    def _run(self) -> None:
        receiver = Receiver(self._bus)
        try:
            while not self._stopping:
                messages = receiver.receive(SLICE_S, prompt=self._prompt)
                if messages or receiver.bad_lines:
                    self._dispatch(messages, receiver.take_bad_lines())
        except Exception as error:  # whatever an adapter's library raises, the drives must hear of it
            self._fail(f"{type(error).__name__}: {error}")
        finally:
            receiver.close()
            close_bus(self._bus)

    def _fail(self, why: str) -> None:
        with self._ready:
            self._failure = why
            self._ready.notify_all()

    def _dispatch(self, messages: Iterable[can.Message], bad_lines: int) -> None:
        """Hand the frames to the drives that want them, and count the rest."""
        host_s, wall_s = time.monotonic(), time.time()
        with self._ready:
            wanting, data_frames, error_frames, bus_off = self._routes.get, 0, 0, False
            for message in messages:
                if message.is_error_frame:
                    error_frames += 1
                    bus_off |= bool(message.arbitration_id & BUS_OFF) and message.dlc == 8
                elif not message.is_remote_frame and message.is_rx:
                    data_frames += 1
                    frame_id = message.arbitration_id  # `frame_key` written out: a call costs as much as the rest
                    for wanted in wanting(frame_id | EXTENDED if message.is_extended_id else frame_id, ()):
                        wanted.append(message)
            for inbox in self._inboxes:
                inbox.counters.unknown_frames += data_frames - len(inbox.sorted_out)
                inbox.counters.framing_errors += error_frames + bad_lines
                if error_frames:
                    inbox.count("error_frames", error_frames)
                if bad_lines:
                    inbox.count("bad_adapter_lines", bad_lines)
            self._hand_out(host_s, wall_s)
            self._ready.notify_all()
        if bus_off:
            raise can.CanOperationError("the controller is bus-off")

    def _hand_out(self, host_s: float, wall_s: float) -> None:
        """What has been sorted out as one batch, of which each drive gets its slice."""
        together = [message for inbox in self._inboxes for message in inbox.sorted_out]
        if not together:
            return
        batch, start = batch_of(together, host_s, wall_s), 0
        for inbox in self._inboxes:
            stop = start + len(inbox.sorted_out)
            if stop > start:
                inbox.put(batch.share(start, stop))
                inbox.sorted_out.clear()
            start = stop
