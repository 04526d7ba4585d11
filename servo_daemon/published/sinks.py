"""What is sent elsewhere, and how that goes: a broker, webhooks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from servo_daemon.published.snapshot import Event, finite_or_none
from servo_daemon.published.times import iso_utc


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
