"""From memory into the database: one turn every few seconds, by one thread.

The queue is what the drives keep anyway: the ring of rows and the list of events. A turn takes what is new since the
last one that was committed; while the database is out of reach nothing is taken, and what the ring overwrites
meanwhile is counted as dropped.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from servo_daemon.errors import ServoDaemonError
from servo_daemon.history.blocks import BlockWriter, drive_id
from servo_daemon.history.database import BrokenError, Database, describe, is_broken
from servo_daemon.history.events import add_document, add_events, read_documents
from servo_daemon.history.levels import Level
from servo_daemon.published.archive import Counts
from servo_daemon.published.diagnosis_state import DiagnosisView
from servo_daemon.published.history import HistoryRing
from servo_daemon.published.memory import of_ring
from servo_daemon.published.sinks import EventSource

log = logging.getLogger(__name__)

#: Rows of a drive that a turn writes at most: five minutes of them, when an outage is made good.
_MOST_ROWS: Final = 3000
#: Old blocks are looked for, and what was written goes onto the disk for good, this often, s: so much of the history a
#: power cut may cost.
_PRUNE_EVERY_S: Final = 60.0
#: Nothing is deleted for its age before wall clock and monotonic clock have gone together for so long, to so much, s: a
#: machine without a battery begins in a wrong year, and a wrong year would delete everything.
_CLOCK_PROVEN_S: Final = 3600.0
_CLOCK_AGREES_S: Final = 60.0
#: Over the quota so much of the largest level goes at a time, as a share.
_SHORTEN_BY: Final = 0.05


class Source(Protocol):
    """What is recorded of a drive."""

    @property
    def name(self) -> str: ...
    @property
    def history(self) -> HistoryRing: ...
    @property
    def log(self) -> EventSource: ...
    @property
    def diagnosis(self) -> DiagnosisView: ...
    @property
    def model(self) -> tuple[str, ...]: ...


class Check:
    """Looks through the whole file in a thread of its own: no row waits for it, and a kill meanwhile costs none.

    Attributes:
        found: what is damaged; None: nothing so far.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self.found: str | None = None
        self.thread = threading.Thread(target=self._look, name="history-check", daemon=True)
        self.thread.start()

    def _look(self) -> None:
        self.found = self._database.damage()


@dataclass(frozen=True, slots=True)
class Mark:
    """How far a drive is written: number of the next row and event, and the last documents."""

    row: int = 0
    event: int = 0
    diagnosed: float | None = None
    model: tuple[str, ...] | None = None


@dataclass
class Recorder:
    """`turn` and `close` belong to the writer's thread. `lock` is held while what was written becomes visible and
    `marks` follow: who holds it sees each row either in the database or after its mark.

    Attributes:
        wanted: the drives from the next turn on that leaves nothing to be written; any thread may exchange them.
        problem: why nothing is written now, in words; None: it is.
        begun: the first turn is over, well or not.
        check: of the file that was opened last, begun once the first rows are in it.
    """

    database: Database
    levels: Sequence[Level]
    sources: Sequence[Source]
    quota_bytes: float
    lock: threading.Lock = field(default_factory=threading.Lock)
    counts: Counts = field(default_factory=Counts)
    problem: str | None = None
    engine: sa.Engine | None = None
    marks: dict[str, Mark] = field(default_factory=dict)
    begun: threading.Event = field(default_factory=threading.Event)
    check: Check | None = None
    _ids: dict[str, int] = field(default_factory=dict)
    _pruned_s: float = 0.0
    _clock: tuple[float, float] | None = None  # wall and monotonic, since when they agree

    def __post_init__(self) -> None:
        self._blocks = BlockWriter(self.levels)
        self.marks = {source.name: Mark() for source in self.sources}
        self.wanted = self.sources

    def turn(self, wall_s: float, monotonic_s: float) -> bool:
        """Write what is new; whether there is more to be written at once. Never raises: a fault is told in `problem`.

        Args:
            wall_s, monotonic_s: both clocks now.
        """
        try:
            more = self._write(wall_s)
            if not more and self.wanted is not self.sources:
                self._change_sources(self.wanted)
            self._look_after(wall_s, monotonic_s)
        except (SQLAlchemyError, OSError, ServoDaemonError, BrokenError) as error:
            self._fail(error)
            return False
        finally:
            self.begun.set()
        if self.problem is not None:
            log.warning(
                "history: %s: written again (%s rows dropped so far)", self.database.where, self.counts.rows_dropped
            )
            self.problem = None
        return more

    def _opened(self) -> sa.Engine:
        if self.engine is not None and self.database.vanished:
            self.engine = self.check = None
        if self.check is not None and self.check.found is not None:
            raise BrokenError(self.check.found)
        if self.engine is None or self.problem is not None:
            engine = self.engine or self.database.open()
            with engine.begin() as connection:
                self._blocks.resume(connection)
                self._ids = {s.name: drive_id(connection, s.name, make=True) or 0 for s in self.sources}
            self.engine = engine
        return self.engine

    def _write(self, wall_s: float) -> bool:
        marks, counts = dict(self.marks), self.counts
        more = False
        with self._opened().connect() as connection, connection.begin() as transaction:
            for source in self.sources:
                marks[source.name], counts = self._write_drive(connection, source, counts, wall_s)
                more = more or marks[source.name].row < source.history.rows - 100
            with self.lock:
                transaction.commit()
                self.marks, self.counts = marks, counts
        self.check = self.check or Check(self.database)
        return more

    def _change_sources(self, wanted: Sequence[Source]) -> None:
        before = {source.name: source for source in self.sources}
        with self._opened().begin() as connection:
            ids = {s.name: drive_id(connection, s.name, make=True) or 0 for s in wanted}
        with self.lock:
            self._ids, self.sources = ids, wanted
            self.marks = {s.name: self.marks[s.name] if before.get(s.name) is s else Mark() for s in wanted}

    def _write_drive(
        self, connection: sa.Connection, source: Source, counts: Counts, wall_s: float
    ) -> tuple[Mark, Counts]:
        drive, mark = self._ids[source.name], self.marks[source.name]
        found = source.history.since(mark.row)
        rows = of_ring(found).take(slice(0, _MOST_ROWS))
        if len(rows):
            self._blocks.add(connection, drive, rows)
        after = found.next if len(rows) == len(found.time_s) else found.first + len(rows)
        number, events = source.log.since(mark.event)
        add_events(connection, drive, events)
        counts = replace(
            counts,
            rows=counts.rows + len(rows),
            rows_dropped=counts.rows_dropped + found.first - mark.row,
            events_dropped=counts.events_dropped + number - mark.event - len(events),
        )
        mark = replace(mark, row=after, event=number)
        return _write_documents(connection, drive, source, mark, wall_s), counts

    def _look_after(self, wall_s: float, monotonic_s: float) -> None:
        """Delete what is too old, or too much; and bring what is there onto the disk."""
        wall0, monotonic0 = self._clock or (wall_s, monotonic_s)
        if self._clock is None or abs((wall_s - wall0) - (monotonic_s - monotonic0)) > _CLOCK_AGREES_S:
            self._clock = wall0, monotonic0 = wall_s, monotonic_s
        if monotonic_s - self._pruned_s < _PRUNE_EVERY_S:
            return
        self._pruned_s = monotonic_s
        with self._opened().begin() as connection:
            if monotonic_s - monotonic0 >= _CLOCK_PROVEN_S:
                self._blocks.prune(connection, wall_s)
            while self.database.size_bytes(connection) > self.quota_bytes:
                if not self._blocks.shorten(connection, _SHORTEN_BY):
                    break
        self.database.checkpoint()

    def _fail(self, error: BaseException) -> None:
        """Say what is wrong, once, and try again in the next turn (reading goes on meanwhile, where it can); a broken
        file is replaced at once."""
        text = f"the history cannot be written to {self.database.where}: {describe(error)}"
        if self.problem is None:
            log.warning("%s; the estimation goes on, and what the memory holds is written when it can be", text)
            self.counts = replace(self.counts, outages=self.counts.outages + 1)
        self.problem = text
        if is_broken(error) and self.database.path is not None:
            self.engine = self.check = None
            try:
                self.database.replace(describe(error))
            except (SQLAlchemyError, OSError) as again:
                log.warning("history: %s cannot be replaced: %s", self.database.where, describe(again))

    def close(self) -> None:
        """End after the last turn."""
        self.database.close()


def _write_documents(connection: sa.Connection, drive: int, source: Source, mark: Mark, wall_s: float) -> Mark:
    """A diagnosis that is done now, a model that is another now; after a start than those that were written last."""
    diagnosis = source.diagnosis.diagnosis
    if diagnosis.status == "done" and mark.diagnosed is None:
        mark = replace(mark, diagnosed=next((d.time for d in read_documents(connection, drive, "diagnosis", 1)), None))
    if diagnosis.status == "done" and diagnosis.finished not in {None, mark.diagnosed}:
        body: dict[str, Any] = {"trigger": diagnosis.trigger, "model": diagnosis.model, "result": diagnosis.result}
        add_document(connection, drive, diagnosis.finished or wall_s, "diagnosis", body)
        mark = replace(mark, diagnosed=diagnosis.finished)
    if mark.model is None and source.history.rows:  # before its first row a drive may not have its last model back
        last = read_documents(connection, drive, "model", 1)
        mark = replace(mark, model=tuple(last[0].body["effects"]) if last else source.model)
    if mark.model is not None and source.model != mark.model:
        add_document(connection, drive, wall_s, "model", {"effects": source.model, "before": mark.model})
        mark = replace(mark, model=source.model)
    return mark
