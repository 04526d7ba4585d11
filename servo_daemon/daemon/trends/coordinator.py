"""The thread that finds the trends of all drives from the history, every hour."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from servo_daemon.background import Background
from servo_daemon.config import DriveConfig
from servo_daemon.config_texts import UNIT_S
from servo_daemon.daemon.trends.watch import FAR, NEAR, already_told, find_trends, names_of, warnings
from servo_daemon.pipeline.event_log import EventLog
from servo_daemon.published.archive import Archive, ArchiveUnavailableError
from servo_daemon.published.trends import DriveTrends

log = logging.getLogger(__name__)

#: First so long after the start, s, then this often: the history's longest buckets are of an hour.
FIRST_S: Final = 60.0
EVERY_S: Final = 3600.0
#: How far back is looked, s: ten years. Motors that live longer have trends of their last ten years.
_BACK_S: Final = 10 * UNIT_S["y"]
_LEVEL: Final = "1 h"
#: Events looked through for warnings that stand since before the start.
_EVENTS: Final = 200


class Source(Protocol):
    """A drive, as far as its trends need it."""

    @property
    def name(self) -> str: ...
    @property
    def active(self) -> DriveConfig: ...
    @property
    def log(self) -> EventLog: ...

    trends: DriveTrends


class TrendCoordinator(Background):
    """Finds the trends of all drives in a thread of its own.

    Args:
        archive: None: no history is kept, and there are no trends.
        sources: the drives; their `trends` are written by the coordinator.
    """

    def __init__(
        self, archive: Archive | None, sources: Sequence[Source], clock: Callable[[], float] = time.time
    ) -> None:
        super().__init__("trends")
        self._archive, self._clock = archive, clock
        self._sources: Sequence[Source] = ()
        self._standing: dict[str, frozenset[str]] = {}
        self.follow(sources)

    def follow(self, sources: Sequence[Source]) -> None:
        """These are the drives from now on; one in another's place has its trends until they are found again."""
        before = {source.name: source for source in self._sources}
        for source in sources:
            old = before.get(source.name)
            if old is None:
                days = source.active.limits.warn_before_d
                none = "no history is kept: [storage] state_dir or [history] says where it could be"
                source.trends = DriveTrends(warn_before_d=days) if self._archive else DriveTrends(None, none, days)
            elif old is not source:
                source.trends = old.trends
        self._sources = sources

    def start(self) -> None:
        if self._archive is not None:
            super().start()

    def _run(self) -> None:
        pause = FIRST_S
        while not self._stop.wait(pause):
            self.turn()
            pause = EVERY_S

    def turn(self) -> None:
        """Find the trends of all drives. Never raises: what cannot be found is told in the record."""
        for source in self._sources:
            if self._archive is None or self._stop.is_set():
                return
            try:
                self._find(self._archive, source)
            except ArchiveUnavailableError as error:  # the history tells of it itself
                source.trends = DriveTrends(None, str(error), source.active.limits.warn_before_d)
            except Exception:  # an error in the program must end neither the thread nor the daemon
                log.exception("drive %s: its trends cannot be found", source.name)

    def _find(self, archive: Archive, source: Source) -> None:
        if source.name not in self._standing:
            page = archive.events(source.name, (NEAR, FAR), None, _EVENTS, None)
            self._standing[source.name] = already_told(page.events)
        config, now = source.active, self._clock()
        hours = archive.span(source.name, names_of(config), now - _BACK_S, None, None, _LEVEL).buckets
        trends = find_trends(config, hours, now)
        self._standing[source.name], told = warnings(self._standing[source.name], trends)
        source.trends = trends
        source.log.tell(told)
