"""What is to be published, between the thread that collects it and the one that has the connection."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

from servo_daemon.disk_queue import DiskQueue
from servo_daemon.mqtt.report import Report

#: Kinds of entries of the queue.
STATE, EVENT = "state", "event"


@dataclass
class Outbox:
    """A drive's newest state waits here for the connection. While there is one, the next state takes its place; while
    there is none, the next one sends it into the queue. Events always go there."""

    queue: DiskQueue

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._online = False
        self._waiting: dict[str, Report] = {}
        self._latest: dict[str, Report] = {}
        self._gone: set[str] = set()

    def offer(self, reports: Sequence[Report]) -> None:
        """New states of drives, one each."""
        with self._lock:
            if not self._online:
                self._keep([self._waiting[r.drive] for r in reports if r.drive in self._waiting])
            new = {r.drive: r for r in reports}
            self._gone -= new.keys()
            self._latest.update(new)
            self._waiting.update(new)

    def keep_event(self, drive: str, body: bytes) -> None:
        """An event, as `event_body` makes it."""
        self.queue.put([(EVENT, drive, body)])

    def dismiss(self, drive: str) -> None:
        """There is no such drive any more."""
        with self._lock:
            self._latest.pop(drive, None)
            self._waiting.pop(drive, None)
            self._gone.add(drive)

    def open(self) -> list[Report]:
        """There is a connection now: the last state of each drive, to be sent on it."""
        with self._lock:
            self._online, self._waiting = True, {}
            return list(self._latest.values())

    def take(self) -> list[Report]:
        """States that wait for the connection."""
        with self._lock:
            taken, self._waiting = list(self._waiting.values()), {}
            return taken

    def take_gone(self) -> set[str]:
        """Drives of which it has to be told that they are gone."""
        with self._lock:
            gone, self._gone = self._gone, set()
            return gone

    def close(self, unsent: Sequence[Report]) -> None:
        """There is no connection any more.

        Args:
            unsent: states of which nobody knows whether they have arrived.
        """
        with self._lock:
            self._online = False
            self._keep(unsent)

    def flush(self) -> None:
        """At the end: what waits goes into the queue, for the next run."""
        with self._lock:
            self._keep(list(self._waiting.values()))
            self._waiting = {}

    def _keep(self, reports: Sequence[Report]) -> None:
        self.queue.put([(STATE, r.drive, r.body()) for r in reports])
