"""The store as the API sees it: what is in the database, and behind it what is still in memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from servo_daemon.history.blocks import drive_id, read_blocks
from servo_daemon.history.database import describe
from servo_daemon.history.events import read_document, read_documents, read_events
from servo_daemon.history.levels import Level, choose
from servo_daemon.history.recorder import Recorder
from servo_daemon.history.tables import BLOCK
from servo_daemon.published.archive import ArchiveUnavailableError, Counts, Document, EventPage, Span
from servo_daemon.published.buckets import Buckets
from servo_daemon.published.memory import of_ring, within
from servo_daemon.published.rollup import fewer, roll_up
from servo_daemon.published.snapshot import Event

Found = TypeVar("Found")

#: Who asks at the start waits so long for the database to be opened, s: a locked one has been told of by then (2 s).
OPENING_S: Final = 5.0


@dataclass(frozen=True)
class StoreArchive:
    """`published.archive.Archive` over a recorder's database. Any thread."""

    recorder: Recorder
    clock: Callable[[], float] = time.time

    @property
    def _levels(self) -> tuple[Level, ...]:
        return tuple(self.recorder.levels)

    @property
    def counts(self) -> Counts:
        """See `Archive`."""
        return self.recorder.counts

    def names(self, drive: str) -> tuple[str, ...]:
        """See `Archive`: of the last hour, day and 90 days that are there."""

        def ask(connection: sa.Connection, number: int | None, fresh: Buckets) -> tuple[str, ...]:
            found = dict.fromkeys(fresh.names)
            for level in self._levels:
                last = None if number is None else _last_stop(connection, number, level)
                if number is not None and last is not None:
                    rows = read_blocks(connection, number, self._levels, level.number, last - level.block_s, last, None)
                    found |= dict.fromkeys(rows.names)
            return tuple(found)

        return self._ask(drive, ask)

    def span(
        self, drive: str, names: Sequence[str] | None, start_s: float, end_s: float | None, points: int | None,
        level: str | None = None,
    ) -> Span:  # fmt: skip
        """See `Archive`."""
        now = self.clock()
        end = now if end_s is None else min(end_s, now)
        if level is None:
            chosen = choose(self._levels, start_s, end, points or 1, now)
        else:
            known = {k.name: k for k in self._levels}
            if level not in known:
                raise ValueError(f"there is no level {level!r}; the levels are {', '.join(known)}")
            chosen = known[level]

        def ask(connection: sa.Connection, number: int | None, fresh: Buckets) -> Buckets:
            if number is None:
                rows = within(fresh if names is None else fresh.select(names), start_s, end)
                return roll_up(rows, chosen.period_s) if chosen.period_s else rows
            return read_blocks(connection, number, self._levels, chosen.number, start_s, end, names, fresh)

        rows = self._ask(drive, ask)
        if points is not None and rows.period_s:
            rows = fewer(rows, points)
        return Span(chosen.name, start_s, end, rows)

    def events(
        self, drive: str, kinds: Sequence[str], since_s: float | None, limit: int, before: int | None
    ) -> EventPage:
        """See `Archive`."""
        now = self.clock()

        def wanted(event: Event) -> bool:
            return (
                (not kinds or event.kind in kinds) and (since_s is None or event.time >= since_s) and event.time <= now
            )

        def ask(connection: sa.Connection, number: int | None, _fresh: Buckets) -> EventPage:
            source = next(s for s in self.recorder.sources if s.name == drive)
            newest = () if before is not None else source.log.since(self.recorder.marks[drive].event)[1]
            late = tuple(e for e in newest if wanted(e))[-limit:]
            if number is None:
                return EventPage(late, None)
            page = read_events(connection, number, kinds, since_s, now, max(1, limit - len(late)), before)
            if len(late) == limit:
                return EventPage(late, None if not page.events else _NEWEST)
            return replace(page, events=page.events + late)

        return self._ask(drive, ask)

    def documents(self, drive: str, kind: str, limit: int) -> Sequence[Document]:
        """See `Archive`."""
        return self._ask(drive, lambda c, number, _: () if number is None else read_documents(c, number, kind, limit))

    def document(self, drive: str, kind: str, number: int) -> Document | None:
        """See `Archive`."""
        return self._ask(drive, lambda c, n, _: None if n is None else read_document(c, n, kind, number))

    def _ask(self, drive: str, question: Callable[[sa.Connection, int | None, Buckets], Found]) -> Found:
        """Asked of one drive, with the rows that are not in the database yet."""
        self.recorder.begun.wait(OPENING_S)
        engine = self.recorder.engine
        if engine is None:
            raise ArchiveUnavailableError(self.recorder.problem or "the history is being opened")
        try:
            with engine.connect() as connection:
                lock: AbstractContextManager[object] = self.recorder.lock
                with lock:
                    source = next((s for s in self.recorder.sources if s.name == drive), None)
                    if source is None:
                        raise ArchiveUnavailableError(f"the history of {drive} begins in a moment")
                    fresh = of_ring(source.history.since(self.recorder.marks[drive].row))
                    return question(connection, drive_id(connection, drive), fresh)
        except SQLAlchemyError as error:
            raise ArchiveUnavailableError(f"the history cannot be read: {describe(error)}") from error


#: Asks for the newest page of the database: every event there comes before this number.
_NEWEST: Final = 2**62


def _last_stop(connection: sa.Connection, drive: int, level: Level) -> float | None:
    c = BLOCK.c
    found = connection.scalar(sa.select(sa.func.max(c.stop)).where(c.drive == drive, c.level == level.number))
    return None if found is None else float(found)
