"""What happened to a drive: the last events, for the API, and the same as log lines."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Final

from servo_daemon.published.snapshot import Event
from servo_daemon.tracking.plan.settings import Message

log = logging.getLogger(__name__)

#: In memory; the history keeps all.
_EVENTS_KEPT: Final = 1000
#: Events that a user should be warned of; the others are information.
_WARNINGS: Final = (
    "disconnected", "unavailable", "misconfigured", "silent", "device_restarted", "pipeline_failed", "filter_restarted",
    "model_mismatch", "channel_frozen", "alarm", "alarm_impossible", "margin_low", "margin_impossible",
    "diagnosis_failed", "overloaded", "behind", "limit_near", "scale_suspected",
)  # fmt: skip


class EventLog:
    """Keeps the last events of one drive. May be used from any thread."""

    def __init__(self, drive: str) -> None:
        self._drive = drive
        self._events: deque[Event] = deque(maxlen=_EVENTS_KEPT)
        self._number = 0  # of events there have ever been
        self._lock = threading.Lock()

    def add(
        self,
        kind: str,
        message: str,
        data: Mapping[str, float | int | str | None] | None = None,
        *,
        logged: bool = True,
    ) -> None:
        """
        Args:
            logged: False: its words stand in the log already.
        """
        if logged:
            level = logging.WARNING if kind in _WARNINGS else logging.INFO
            fields = {**(data or {}), "drive": self._drive, "event": kind}  # for the journal
            log.log(level, "drive %s: %s", self._drive, message, extra={"fields": fields})
        with self._lock:
            self._events.append(Event(time.time(), kind, message, data or {}))
            self._number += 1

    def tell(self, messages: Sequence[Message]) -> None:
        for kind, message, data in messages:
            self.add(kind, message, data)

    def all(self) -> Sequence[Event]:
        """The last events, oldest first."""
        return tuple(self._events.copy())  # a copy is atomic; iterating while another thread appends is not

    def since(self, number: int) -> tuple[int, Sequence[Event]]:
        """How many events there have ever been, and those from that number on that are still kept."""
        with self._lock:
            new = min(self._number - number, len(self._events))
            return self._number, tuple(islice(self._events, len(self._events) - new, None))
