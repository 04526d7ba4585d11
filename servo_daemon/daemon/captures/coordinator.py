"""Decides which samples are kept: those of the minute around an event, those that a diagnosis begins with, and what
somebody asks for. One thread looks at the events and writes; the pipelines know nothing of it."""

from __future__ import annotations

import logging
import queue
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Final, Protocol

from drivers.base import DriveInfo
from servo_daemon import __version__
from servo_daemon.background import Background
from servo_daemon.config import DriveConfig
from servo_daemon.daemon.captures.folder import CaptureFolder
from servo_daemon.daemon.diagnosis.files import capture_metadata
from servo_daemon.errors import BusyError, CaptureError, RefusedError, ServoDaemonError
from servo_daemon.pipeline.event_log import EventLog
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.published.archive import KeptCapture
from servo_daemon.published.snapshot import Event, Snapshot
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

log = logging.getLogger(__name__)

#: Events whose cause is in the samples around them. Of a diagnosis its beginning: it is given the samples of then.
KINDS: Final = frozenset({
    "alarm", "parameter_jump", "margin_low", "model_mismatch", "filter_restarted", "channel_frozen", "device_restarted",
    "disconnected", "silent", "pipeline_failed", "diagnosis_started",
})  # fmt: skip
#: Events are looked at this often, s; so much later than the event the samples before it are set aside.
_TURN_S: Final = 0.5
#: Half of the minute around an event, s.
HALF_S: Final = 30.0
#: The same kind of event of a drive is captured again after so long, s: an alarm that comes and goes each minute would
#: otherwise replace all else, and wear the disk.
_AGAIN_S: Final = 600.0
#: Less says nothing, s.
_LEAST_S: Final = 1.0
#: Requests that wait for the disk.
_MOST_REQUESTS: Final = 8
#: Captures of events that wait for a place to be written to: a minute of one drive at 1 kHz takes about 2 MB of memory.
_MOST_WAITING: Final = 4
#: The place is tried again after so long, s.
_RETRY_S: Final = 2.0


class Source(Protocol):
    """What is recorded of a drive."""

    @property
    def name(self) -> str: ...
    @property
    def active(self) -> DriveConfig: ...
    @property
    def info(self) -> DriveInfo: ...
    @property
    def meaning(self) -> SignalMeaning: ...
    @property
    def ring(self) -> SampleRing: ...
    @property
    def log(self) -> EventLog: ...
    def snapshot(self) -> Snapshot: ...


@dataclass(frozen=True, slots=True)
class _Recording:
    """Samples and when they were taken: `end` of the last one, UTC, seconds since the epoch."""

    blocks: tuple[SampleBlock, ...]
    end: float

    @property
    def span_s(self) -> float:
        return float(self.blocks[-1].time_s[-1]) - float(self.blocks[0].time_s[0]) if self.blocks else 0.0

    def last(self, seconds: float) -> _Recording:
        """At most so much of its end, in whole ticks."""
        if not self.blocks:
            return self
        first = float(self.blocks[-1].time_s[-1]) - seconds
        return _Recording(tuple(b for b in self.blocks if float(b.time_s[0]) >= first) or self.blocks[-1:], self.end)

    def then(self, later: _Recording) -> _Recording:
        """With what came after it, where the later one goes on from it; itself where that has begun anew."""
        if not self.blocks or not later.blocks or later.blocks[0].channels != self.blocks[0].channels:
            return self
        last = float(self.blocks[-1].time_s[-1])
        if not float(later.blocks[0].time_s[0]) <= last < float(later.blocks[-1].time_s[-1]):
            return self
        new = tuple(b for b in later.blocks if float(b.time_s[0]) > last)
        return _Recording(self.last(HALF_S).blocks + new, later.end)


@dataclass(frozen=True, slots=True)
class _Pending:
    """An event, what came before it, and when there is enough after it, host monotonic, s."""

    source: Source
    event: Event
    before: _Recording
    due_s: float


@dataclass(frozen=True, slots=True)
class _Capture:
    """What is to be written of a drive; start and end UTC, seconds since the epoch."""

    drive: str
    kind: str
    start: float
    end: float
    blocks: tuple[SampleBlock, ...]
    metadata: Mapping[str, str]

    @classmethod
    def of(cls, source: Source, kind: str, recording: _Recording, event: Event | None = None) -> _Capture:
        told = {} if event is None else {"event": event.kind, "event_message": event.message}
        metadata = capture_metadata(source.active, source.info, __version__, source.meaning) | told
        end = recording.end if event is None else max(recording.end, event.time)
        return cls(source.name, kind, recording.end - recording.span_s, end, recording.blocks, metadata)

    def store(self, folder: CaptureFolder) -> KeptCapture:
        """See `CaptureFolder.store`."""
        return folder.store(self.drive, self.kind, self.start, self.end, self.blocks, self.metadata)

    def lost(self, error: ServoDaemonError) -> None:
        log.warning("drive %s: the capture of %s is lost: %s", self.drive, self.kind, error)


def _recorded(source: Source) -> _Recording:
    return _Recording(source.ring.blocks(), source.snapshot().time or time.time())


class CaptureCoordinator(Background):
    """Keeps samples around events, in a thread of its own.

    Args:
        folder: where they are kept.
        sources: the drives.

    Attributes:
        problem: why what was recorded of an event waits, in words; None: all is written.
    """

    def __init__(self, folder: CaptureFolder, sources: Sequence[Source]) -> None:
        super().__init__("captures")
        self.problem: str | None = None
        self._folder, self._sources = folder, {s.name: s for s in sources}
        self._seen: dict[str, tuple[Source, int]] = {}  # how many events of it
        self._pending: dict[str, _Pending] = {}
        self._waiting: deque[_Capture] = deque()
        self._retry_s = 0.0
        self._quiet_until: dict[tuple[str, str], float] = {}
        self._asked: queue.Queue[tuple[Source, _Recording, Future[KeptCapture]]] = queue.Queue(_MOST_REQUESTS)

    def of(self, drive: str) -> Sequence[KeptCapture]:
        """See `published.archive.Captures`."""
        return self._folder.of(drive)

    def request(self, drive: str, seconds: float) -> Future[KeptCapture]:
        """See `published.archive.Captures`."""
        source = self._sources.get(drive)
        if source is None:
            raise BusyError(f"drive {drive} has gone from the configuration")
        if source.ring.seconds <= 0:
            raise RefusedError("the configuration keeps no samples (ring_s = 0)")
        recording = _recorded(source).last(seconds)
        if recording.span_s <= 0:
            raise BusyError("no samples are there")
        future: Future[KeptCapture] = Future()
        try:
            self._asked.put_nowait((source, recording, future))
        except queue.Full as error:
            raise BusyError(f"{_MOST_REQUESTS} captures wait to be written") from error
        self._wake.set()
        return future

    def follow(self, sources: Sequence[Source]) -> None:
        """These are the drives from now on; of those that have gone what is pending is written with what there is."""
        self._sources = {s.name: s for s in sources}

    def _run(self) -> None:
        self._go_round(lambda last: self.turn(time.monotonic(), end=last), _TURN_S)

    def turn(self, now_s: float, *, end: bool = False) -> None:
        """Look at what has happened, and write what is due.

        Args:
            now_s: host monotonic.
            end: write all that is pending, due or not.
        """
        while not self._asked.empty():
            source, recording, future = self._asked.get_nowait()
            if not future.set_running_or_notify_cancel():
                continue  # whoever asked waits no longer
            try:
                future.set_result(_Capture.of(source, "request", recording).store(self._folder))
            except Exception as error:
                future.set_exception(error)
        self._write_due(now_s, end=False)  # of a drive that has another in its place since
        for source in self._sources.values():
            self._note(source, now_s)
        self._write_due(now_s, end=end)
        self._write_waiting(now_s, end=end)

    def _write_due(self, now_s: float, *, end: bool) -> None:
        for name, pending in list(self._pending.items()):
            source = pending.source
            has_gone = self._sources.get(name) is not source or source.snapshot().connection != "connected"
            if end or has_gone or now_s >= pending.due_s:
                del self._pending[name]
                self._write(source, pending.event, pending.before.then(_recorded(source)))

    def _note(self, source: Source, now_s: float) -> None:
        """Set aside what came before the first event that is worth it; its capture holds those that follow soon."""
        watched, number = self._seen.get(source.name, (source, 0))
        number, events = source.log.since(number if watched is source else 0)
        self._seen[source.name] = source, number
        for event in events:
            key, begins = (source.name, event.kind), event.kind == "diagnosis_started"
            if event.kind not in KINDS or now_s < self._quiet_until.get(key, 0.0):
                continue
            if source.name in self._pending and not begins:
                continue
            before = _recorded(source)
            if before.span_s < _LEAST_S:
                continue
            self._quiet_until[key] = now_s + _AGAIN_S
            if begins:
                self._write(source, event, before)
            else:
                self._pending[source.name] = _Pending(source, event, before, now_s + HALF_S)

    def _write(self, source: Source, event: Event, recording: _Recording) -> None:
        self._waiting.append(_Capture.of(source, event.kind, recording, event))
        self._retry_s = 0.0

    def _write_waiting(self, now_s: float, *, end: bool) -> None:
        """Write what there is of events; what cannot be written waits while there is room, and is tried again."""
        if not end and now_s < self._retry_s:
            return
        while self._waiting:
            try:
                self._waiting[0].store(self._folder)
            except (BusyError, CaptureError) as error:  # the samples are no capture: nothing is wrong with the place
                self._waiting[0].lost(error)
            except ServoDaemonError as error:
                self.problem = f"captures cannot be kept: {error}"
                self._retry_s = now_s + _RETRY_S
                while len(self._waiting) > (0 if end else _MOST_WAITING):
                    self._waiting.popleft().lost(error)
                return
            self._waiting.popleft()
        self.problem = None
