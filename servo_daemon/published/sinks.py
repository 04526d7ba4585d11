"""What is sent elsewhere, and how that goes: a broker, webhooks."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from servo_daemon.published.snapshot import Event, finite_or_none
from servo_daemon.published.units import iso_utc


@dataclass(frozen=True, slots=True)
class SinkState:
    """One of them.

    Attributes:
        name: "mqtt", "webhook_1", …
        connected: whether the last attempt to reach it went well; None: there has been none.
        waiting: events and states that are kept for it.
        sent, dropped: since the start.
        reconnects: times it could be reached again.
        reason: why it cannot be reached, in words.
        problem: what is wrong with the daemon's own part of it, in words: the buffer cannot be written.
    """

    name: str
    connected: bool | None = None
    waiting: int = 0
    sent: int = 0
    dropped: int = 0
    reconnects: int = 0
    reason: str | None = None
    problem: str | None = None


def encode(document: Mapping[str, Any]) -> bytes:
    """As compact UTF-8 JSON.

    Raises:
        ValueError: NaN or an infinity in it.
    """
    return json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode("utf-8", "replace")


def event_body(drive: str, event: Event) -> bytes:
    """An event as it is sent: drive, time, kind, message, data."""
    data = {k: finite_or_none(v) if isinstance(v, float) else v for k, v in event.data.items()}
    time = iso_utc(event.time)
    return encode({"drive": drive, "time": time, "kind": event.kind, "message": event.message, "data": data})


class EventSource(Protocol):
    """A drive's events, numbered as they come."""

    def since(self, number: int) -> tuple[int, Sequence[Event]]:
        """How many there have been ever, and those from that number on that are still kept."""


class HasEvents(Protocol):
    """A drive, as far as its events go."""

    @property
    def name(self) -> str: ...
    @property
    def log(self) -> EventSource: ...


Source = TypeVar("Source", bound=HasEvents)


class Followed(Generic[Source]):
    """Drives, and which of their events have been taken. `take` belongs to one thread; any may set `wanted`.

    Attributes:
        sources: the drives now.
        wanted: those from the next `take` on.
    """

    def __init__(self, sources: Sequence[Source]) -> None:
        self.sources = self.wanted = sources
        self._marks = {source.name: 0 for source in sources}

    def take(self) -> list[tuple[str, Event]]:
        """New events, each with its drive; the last ones of drives that go, too."""
        wanted, found = self.wanted, self._take()
        if wanted is not self.sources:
            before = {source.name: source for source in self.sources}
            self._marks = {s.name: self._marks[s.name] if before.get(s.name) is s else 0 for s in wanted}
            self.sources = wanted
        return found

    def _take(self) -> list[tuple[str, Event]]:
        found: list[tuple[str, Event]] = []
        for source in self.sources:
            self._marks[source.name], events = source.log.since(self._marks[source.name])
            found += [(source.name, event) for event in events]
        return found
