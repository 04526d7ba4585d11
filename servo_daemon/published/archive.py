"""What the API may ask of what is kept: the store of the past, and captures. The daemon implements it; the API knows
nothing else of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from servo_daemon.published.buckets import Buckets
from servo_daemon.published.snapshot import Event


class ArchiveUnavailableError(Exception):
    """The store cannot be read now; the text says why, in words."""


@dataclass(frozen=True, slots=True)
class EventPage:
    """Events, oldest first. `next`: what asks for those before them; None: there are none."""

    events: tuple[Event, ...]
    next: int | None


@dataclass(frozen=True, slots=True)
class Document:
    """Something kept whole: `number` is its own, `time` UTC seconds since the epoch, `kind` "diagnosis" or "model"."""

    number: int
    time: float
    kind: str
    body: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Span:
    """An answer about a span of time.

    Attributes:
        level: name of the level it is from: "rows", "1 s", "1 min", "1 h".
        start_s, end_s: the span, UTC seconds since the epoch.
        buckets: in it, sorted; possibly of longer buckets than the level's, so that they are few enough.
    """

    level: str
    start_s: float
    end_s: float
    buckets: Buckets


@dataclass(frozen=True, slots=True)
class Counts:
    """What has happened to rows and events since the start; `outages`: times the database went out of reach."""

    rows: int = 0
    rows_dropped: int = 0
    events_dropped: int = 0
    outages: int = 0


class Archive(Protocol):
    """The past of all drives. Each method may wait for a disk or a server: not for the event loop. All raise
    ArchiveUnavailableError. `counts` does neither."""

    @property
    def counts(self) -> Counts:
        """What was written and what was lost."""

    def names(self, drive: str) -> tuple[str, ...]:
        """Series of that drive of which the newest blocks of any level hold something."""

    def span(
        self, drive: str, names: Sequence[str] | None, start_s: float, end_s: float | None, points: int | None,
        level: str | None = None,
    ) -> Span:  # fmt: skip
        """The past of these series (None: all), up to now at most, from the level that suits `points`.

        Args:
            end_s: None: now.
            points: at most so many buckets; single rows are given as they are, the caller thins them. None: all.
            level: by name, instead of the one that suits.

        Raises:
            ValueError: no such level.
        """

    def events(
        self, drive: str, kinds: Sequence[str], since_s: float | None, limit: int, before: int | None
    ) -> EventPage:
        """The last `limit` events that match, up to now, oldest first."""

    def documents(self, drive: str, kind: str, limit: int) -> Sequence[Document]:
        """The last diagnoses or models, oldest first."""

    def document(self, drive: str, kind: str, number: int) -> Document | None:
        """One of them; None: there is none of that number."""


@dataclass(frozen=True, slots=True)
class KeptCapture:
    """One file.

    Attributes:
        id: unique among a drive's; letters, digits and "-".
        kind: of the event that it was kept for; "request" where somebody has asked for it.
        start, end: UTC, seconds since the epoch: from its first sample to its last, or to the event if that was noticed
            later.
        size: bytes.
    """

    id: str
    drive: str
    kind: str
    start: float
    end: float
    size: int
    path: Path


class Captures(Protocol):
    """All drives'. Any thread; nothing here waits for a disk."""

    def of(self, drive: str) -> Sequence[KeptCapture]:
        """Those of that drive, oldest first."""

    def request(self, drive: str, seconds: float) -> Future[KeptCapture]:
        """Have the last samples of that drive written; done when the file is there, with a ServoDaemonError if it came
        to nothing.

        Args:
            seconds: at most so much of device time.

        Raises:
            BusyError: too few samples are there, or too much is being written.
            RefusedError: the configuration does not allow it.
        """
