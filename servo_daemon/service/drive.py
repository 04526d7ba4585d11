"""Everything one drive is at run time: reader, pipeline, history, events, and the snapshot the API reads."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from drivers.base import Driver
from servo_daemon.config import DriveConfig
from servo_daemon.errors import NumericalError
from servo_daemon.estimators.settings import Message
from servo_daemon.samples import SampleBlock, concatenate
from servo_daemon.service.alarms import Alarms
from servo_daemon.service.controller import incomplete, loop_facts
from servo_daemon.service.history import HistoryRing
from servo_daemon.service.knowledge import LoopFacts
from servo_daemon.service.margin_watch import ALARM, MarginWatch
from servo_daemon.service.persist import StateFile
from servo_daemon.service.pipeline import Pipeline, all_finite
from servo_daemon.service.publish import SavedState, published_parameters
from servo_daemon.service.reader import Link, Reader
from servo_daemon.service.snapshot import Estimate, Event, ParameterEstimate, Snapshot
from servo_daemon.service.view import initial_parameters

log = logging.getLogger(__name__)

_EVENTS_KEPT = 1000
#: A pipeline that fails again and again is told this often, s; every failure is counted.
_FAILURE_SAID_EVERY_S = 60.0
#: Line events that a user should be warned of; the others are information.
_WARNINGS = (
    "disconnected", "unavailable", "misconfigured", "silent", "device_restarted", "pipeline_failed", "filter_restarted",
    "model_mismatch", "channel_frozen", "alarm", "alarm_impossible", "margin_low", "margin_impossible",
)  # fmt: skip


class DriveRuntime:
    """One drive in the daemon. `work` and `offer_state` belong to the worker thread, `save_offered` to the saver;
    everything public else is read-only and may be called from any thread.

    Args:
        config: the drive.
        driver: closed.
        state_dir: where its knowledge is kept over a restart; None: nowhere.
        wake: called when there is work, from the reader's thread.
    """

    def __init__(self, config: DriveConfig, driver: Driver, state_dir: Path | None, wake: Callable[[], None]) -> None:
        self.config = config
        self.history = HistoryRing()
        self.reader = Reader(driver, wake, self._line_event)
        self._file = StateFile(state_dir, config.name)
        self._events: deque[Event] = deque(maxlen=_EVENTS_KEPT)
        self._pipeline: Pipeline | None = None
        self._identity: str | None = None
        self._info = driver.info
        self._estimate: Estimate | None = None
        self._sample_time: float | None = None
        self._failures = self._repeated = 0
        self._quiet_until = 0.0
        self._reset_wanted = False
        self._was_silent = False
        self._saving = threading.Lock()
        self._offered: tuple[str, SavedState] | None = None
        self._unwritable = False
        self._link: Link = self.reader.link
        self._initial = initial_parameters(published_parameters(config), config.nominal)
        self._alarms = Alarms(config)
        self._margins = MarginWatch(loop_facts(config))
        self._tell(self._alarms.impossible)
        if (why := incomplete(config.controller)) is not None:
            self._event("margin_impossible", f"margins cannot be watched: {why}", {})
        self._snapshot = self._make_snapshot()

    @property
    def name(self) -> str:
        return self.config.name

    @property
    def driver(self) -> str:
        return self.config.driver

    @property
    def model(self) -> tuple[str, ...]:
        """Effects on top of the linear motor, as they are now."""
        return self.config.model

    @property
    def initial_parameters(self) -> Sequence[ParameterEstimate]:
        """What is published before the first samples."""
        return self._initial

    @property
    def loop(self) -> LoopFacts:
        """What is known of the control loop around this drive."""
        return loop_facts(self.config, self.reader.driver.info.counts_per_rev)

    def snapshot(self) -> Snapshot:
        """The last published state; immutable."""
        return self._snapshot

    def events(self) -> Sequence[Event]:
        """The last events, oldest first."""
        return tuple(self._events.copy())  # a copy is atomic; iterating while another thread appends is not

    def request_reset(self) -> None:
        """Forget what was learned; carried out by the worker before the next samples."""
        self._reset_wanted = True

    # -- worker thread ---------------------------------------------------------------------------------------

    def work(self) -> bool:
        """Process what has arrived and publish. Returns whether there were samples."""
        was_reset = self._reset_wanted
        if was_reset:
            self._reset()
        blocks = self.reader.queue.take_all()
        if blocks:
            self._sample_time = time.time()
            try:
                self._process(blocks)
            except Exception:  # one drive's trouble must not stop the others
                self._fail()
        self._follow_link(bool(blocks) or was_reset)
        return bool(blocks)

    def offer_state(self) -> None:
        """Lay out what is worth keeping for `save_offered`, if the drive is well and there is something. Worker thread:
        the pipeline is its own."""
        if self._pipeline is None or self._identity is None or self._link.connection != "connected":
            return
        saved = self._pipeline.save()
        if saved is not None:
            self._offered = (self._identity, saved)

    def save_offered(self) -> None:
        """Write what was laid out. Saver thread: a disk may be slow."""
        with self._saving:
            offered, self._offered = self._offered, None
            if offered is not None:
                self._unwritable = not self._file.save(*offered)

    @property
    def problem(self) -> str | None:
        """What is wrong with this drive's part of the daemon (not with the drive), in words."""
        return f"drive {self.name}: its state cannot be saved" if self._unwritable else None

    def _process(self, blocks: list[SampleBlock]) -> None:
        pipeline = self._pipeline_for_device()
        repeated = pipeline.samples_repeated
        for run in _same_channels(blocks):
            pipeline.process(concatenate(run), rows=False)
        self._repeated += pipeline.samples_repeated - repeated
        estimate = pipeline.current()
        if estimate is not None and not all_finite(estimate):
            raise NumericalError("an estimate is not a number")
        self._tell(pipeline.messages)
        pipeline.messages.clear()
        if estimate is not None:
            self._tell(self._alarms.update(estimate))
            self._tell(self._margins.update(estimate))
            ringing = [name for name in (self._alarms.active, ALARM if self._margins.low else None) if name]
            health = {**estimate.health, **self._margins.health, "alarms": ",".join(ringing) or None}
            estimate = replace(estimate, health=health)
        self._estimate = estimate

    def _pipeline_for_device(self) -> Pipeline:
        """The pipeline of the device that is attached now; a new device starts from what is known of it."""
        info = self.reader.driver.info
        # Between two attachments a driver may not know yet who is there: what still waits in the queue is the last's.
        other = bool(self._identity) and bool(info.identity) and info.identity != self._identity
        if self._pipeline is None or other:
            if self._pipeline is not None:
                self._event("device_changed", f"another device is attached: {info.identity}", {})
                self._forget_alarms("another device is attached")
            saved = self._file.load(info.identity, self.config.model)
            if saved is not None:
                self._event("state_restored", "estimates of the last run restored", {})
            self._pipeline = Pipeline(self.config, info, saved)
            self._identity, self._info = info.identity, info
        elif info != self._info:
            self._pipeline.learn_info(info)
            self._identity, self._info = info.identity or self._identity, info
        return self._pipeline

    def _fail(self) -> None:
        self._failures += 1
        now = time.monotonic()
        if now >= self._quiet_until:  # a failure that comes with every block must not fill the disk
            self._quiet_until = now + _FAILURE_SAID_EVERY_S
            log.exception("drive %s: the pipeline failed; it starts over", self.name)
            text = "the pipeline failed and starts over; the log has the details"
            self._event("pipeline_failed", text, {"failures": self._failures})
        if self._pipeline is not None:
            self._pipeline.reset()
        self._estimate = None

    def _reset(self) -> None:
        self._reset_wanted = False
        with self._saving:  # nothing older may be written after it
            self._offered = None
            self._file.forget()
        if self._pipeline is not None:
            self._pipeline.reset()
        self._estimate = None
        self._event("reset", "estimates reset by request", {})
        self._forget_alarms("estimates were reset")

    def _follow_link(self, changed: bool) -> None:
        """Publish when something changed; say once when the drive falls silent or speaks again."""
        link = self.reader.link
        silent = link.connection == "silent"
        if silent and not self._was_silent:
            self._event("silent", "drive is connected but sends no samples", {})
        elif self._was_silent and link.connection == "connected":
            self._event("speaking", "drive sends samples again", {})
        self._was_silent = silent or (self._was_silent and link.connection != "connected")
        if changed or link != self._link:
            self._link = link
            self._snapshot = self._make_snapshot()
            self.history.append(self._snapshot)

    # -- helpers ---------------------------------------------------------------------------------------------

    def _make_snapshot(self) -> Snapshot:
        estimate = self._estimate
        if estimate is not None and self._link.connection != "connected":
            estimate = _stale(estimate, self._link)
        return Snapshot(
            drive=self.name,
            driver=self.driver,
            time=self._sample_time,
            connection=self._link.connection,
            reason=self._link.reason,
            estimate=estimate,
            counters=self._counters(),
            truth=self.reader.driver.truth(),
        )

    def _counters(self) -> dict[str, int]:
        c = self.reader.driver.counters
        return {
            "samples": c.samples,
            "samples_lost": c.samples_lost + self.reader.queue.dropped,
            "queue_dropped": self.reader.queue.dropped,
            "queue_samples": self.reader.queue.samples,
            "samples_repeated": c.samples_repeated + self._repeated,
            "frames": c.frames,
            "crc_errors": c.crc_errors,
            "framing_errors": c.framing_errors,
            "unknown_frames": c.unknown_frames,
            "device_restarts": c.device_restarts,
            "reconnects": self.reader.reconnects,
            "pipeline_failures": self._failures,
            **c.extra,
        }

    def _forget_alarms(self, why: str) -> None:
        self._tell(self._alarms.forget(why))
        self._tell(self._margins.forget(why))

    def _line_event(self, kind: str, message: str) -> None:
        self._event(kind, message, {})

    def _tell(self, messages: Sequence[Message]) -> None:
        for kind, message, data in messages:
            self._event(kind, message, data)

    def _event(self, kind: str, message: str, data: Mapping[str, float | int | str | None]) -> None:
        level = logging.WARNING if kind in _WARNINGS else logging.INFO
        log.log(level, "drive %s: %s", self.name, message)
        self._events.append(Event(time.time(), kind, message, data))


def _same_channels(blocks: list[SampleBlock]) -> list[list[SampleBlock]]:
    """Neighbouring blocks that can be joined: the same channels, and no restart inside."""
    runs: list[list[SampleBlock]] = []
    for block in blocks:
        joins = runs and runs[-1][-1].channels == block.channels and runs[-1][-1].time_s[-1] < block.time_s[0]
        if joins:
            runs[-1].append(block)
        else:
            runs.append([block])
    return runs


def _stale(estimate: Estimate, link: Link) -> Estimate:
    """The last estimate of a drive that does not speak now: values stay, their status says so."""
    why = link.reason or "the drive is not connected"
    if link.connection == "ended":
        return estimate
    parameters = tuple(replace(p, status="invalid", reason=why) for p in estimate.parameters)
    return replace(estimate, parameters=parameters)
