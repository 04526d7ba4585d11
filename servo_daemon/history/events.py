"""Events and documents (diagnoses, models) in the database: kept for good."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from servo_daemon.history.tables import DOCUMENT, EVENT
from servo_daemon.published.archive import Document, EventPage
from servo_daemon.published.snapshot import Event


def add_events(connection: sa.Connection, drive: int, events: Sequence[Event]) -> None:
    """Append events of a drive."""
    rows = [
        {"drive": drive, "time": e.time, "kind": e.kind, "message": e.message, "data": _text(_finite(e.data))}
        for e in events
    ]
    if rows:
        connection.execute(sa.insert(EVENT), rows)


def read_events(
    connection: sa.Connection, drive: int, kinds: Sequence[str], since_s: float | None, until_s: float, limit: int,
    before: int | None,
) -> EventPage:  # fmt: skip
    """The last `limit` events that match, oldest first.

    Args:
        kinds: none: all.
        before: only events before that of this number: the `next` of the page after.
    """
    c = EVENT.c
    query = sa.select(c.id, c.time, c.kind, c.message, c.data).where(c.drive == drive, c.time <= until_s)
    if kinds:
        query = query.where(c.kind.in_(kinds))
    if since_s is not None:
        query = query.where(c.time >= since_s)
    if before is not None:
        query = query.where(c.id < before)
    found = connection.execute(query.order_by(c.id.desc()).limit(limit + 1)).all()
    page = found[:limit]
    events = tuple(Event(r.time, r.kind, r.message, json.loads(r.data)) for r in reversed(page))
    return EventPage(events, page[-1].id if len(found) > limit else None)


def add_document(connection: sa.Connection, drive: int, time_s: float, kind: str, body: Mapping[str, Any]) -> None:
    """Append a document of a drive."""
    values = {"drive": drive, "time": time_s, "kind": kind, "body": _text(body)}
    connection.execute(sa.insert(DOCUMENT), values)


def read_documents(connection: sa.Connection, drive: int, kind: str, limit: int) -> tuple[Document, ...]:
    """The last of that kind, oldest first."""
    c = DOCUMENT.c
    query = sa.select(c.id, c.time, c.kind, c.body).where(c.drive == drive, c.kind == kind)
    found = connection.execute(query.order_by(c.id.desc()).limit(limit)).all()
    return tuple(Document(r.id, r.time, r.kind, json.loads(r.body)) for r in reversed(found))


def read_document(connection: sa.Connection, drive: int, kind: str, number: int) -> Document | None:
    """The document of this number; None: there is none."""
    c = DOCUMENT.c
    query = sa.select(c.id, c.time, c.kind, c.body).where(c.id == number, c.drive == drive, c.kind == kind)
    r = connection.execute(query).first()
    return None if r is None else Document(r.id, r.time, r.kind, json.loads(r.body))


def _finite(data: Mapping[str, float | int | str | None]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in data.items()}


def _text(document: Mapping[str, Any]) -> str:
    return json.dumps(document, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
