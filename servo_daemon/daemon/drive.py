"""Everything one drive is at run time: reader, estimation, history, events, and the snapshot the API reads."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.base import DriveInfo, Driver
from servo_daemon.config import DriveConfig
from servo_daemon.daemon.diagnosis.runner import DiagnosisRunner
from servo_daemon.daemon.estimation import Estimation
from servo_daemon.daemon.learning_coordinator import Subscription
from servo_daemon.daemon.lines.ports import Ports
from servo_daemon.daemon.lines.reader import Link, Reader
from servo_daemon.daemon.load import LoadWatch
from servo_daemon.errors import RefusedError
from servo_daemon.pipeline.controller import loop_facts
from servo_daemon.pipeline.event_log import EventLog
from servo_daemon.pipeline.model_change import checked_request
from servo_daemon.pipeline.publish import published_parameters
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.pipeline.views import Moment
from servo_daemon.published.diagnosis_state import DiagnosisView
from servo_daemon.published.history import HistoryRing
from servo_daemon.published.knowledge import LoopFacts
from servo_daemon.published.snapshot import AlarmLimit, Estimate, Event, ParameterEstimate, Snapshot
from servo_daemon.published.trends import DriveTrends
from servo_daemon.published.view import ModelChange, StartValues, initial_parameters
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning
from servo_daemon.tracking.plan.settings import Message

#: Samples of a round, in whole blocks: half a second of a drive at a kilohertz. Between rounds it is seen whether the
#: worker keeps up, and what was found is published.
_ROUND_SAMPLES = 500
#: Fewer where they would take longer, s of CPU time: half of what a drive keeps its place for (`worker._SLICE_S`). (500
#: samples take filterpy one to two seconds, in which the drives that start beside it waited.)
_ROUND_S = 0.25
#: So much of its samples, s, a drive starts: the maximum-likelihood restart of its first samples ends by then
#: (`tracking/restart/maximum_likelihood.py`). At most for so much CPU time, s: three times what that takes on a machine
#: of half the usual speed. (Two slow drives, each "starting" for minutes, excused each other's lateness.)
_START_S, _START_CPU_S = 20.0, 5.0


@dataclass(slots=True)
class _Published:
    """What a snapshot is made from, and the snapshot once somebody has asked for it."""

    sample_time: float | None
    link: Link
    now: Moment | None
    overloaded: bool
    behind_s: float
    made: Snapshot | None = None


class DriveRuntime:
    """One drive in the daemon. `work` and `offer_state` belong to the worker thread, `save_offered` to the saver;
    everything public else is read-only and may be called from any thread.

    Args:
        config: the drive.
        driver: closed.
        state_dir: where its knowledge is kept over a restart; None: nowhere.
        wake: called when there is work, from the reader's thread.
        runner: of diagnoses, one for all drives.
        subscription: where learned models come from; None: nowhere.
        ports: that read the drive's line beside others'; None: it has a thread of its own for that.
    """

    def __init__(
        self,
        config: DriveConfig,
        driver: Driver,
        state_dir: Path | None,
        wake: Callable[[], None],
        runner: DiagnosisRunner | None = None,
        subscription: Subscription | None = None,
        ports: Ports | None = None,
    ) -> None:
        self.name, self.driver = config.name, config.driver
        self.subscription = subscription
        self.history = HistoryRing()
        self.log = EventLog(config.name)
        self.reader = Reader(driver, wake, self.log.add, ports)
        self._ports = ports
        runner = runner or DiagnosisRunner()
        self._estimation = Estimation(config, driver, state_dir, self.log, wake, runner, subscription)
        self.trends = DriveTrends()  # written by the coordinator of trends
        self._sample_time: float | None = None
        self.held_up = False  # others start, or catch up; told by whoever turns the drives
        self._was_silent = False
        self._link: Link = self.reader.link
        self._load = LoadWatch()
        self._round_samples, self._used_s = float(_ROUND_SAMPLES), 0.0
        self._published = self._publish()

    @property
    def active(self) -> DriveConfig:
        """Its configuration, with the model as it is now."""
        return self._estimation.active

    @property
    def model(self) -> tuple[str, ...]:
        """Effects on top of the linear motor, as they are now."""
        return self.active.model

    @property
    def info(self) -> DriveInfo:
        """Of the device whose samples came last."""
        return self._estimation.info

    @property
    def meaning(self) -> SignalMeaning:
        """Of its signals: as configured, and else as the driver says."""
        return self._estimation.meaning

    @property
    def ring(self) -> SampleRing:
        """The ring of its last samples."""
        return self._estimation.ring

    @property
    def initial_parameters(self) -> Sequence[ParameterEstimate]:
        """What is published before the first samples."""
        return initial_parameters(published_parameters(self.active), self.active.nominal)

    @property
    def loop(self) -> LoopFacts:
        """What is known of the control loop around this drive."""
        return loop_facts(self._estimation.config, self.reader.driver.info.counts_per_rev)

    @property
    def limits(self) -> Sequence[AlarmLimit]:
        """Those whose alarms can ring."""
        return self._estimation.warnings.limits

    def newest(self) -> Snapshot:
        """The last published state for a client that may wait for the next; see `DriveView`."""
        if self._ports is not None:
            self._ports.ask(self.name)
        return self.snapshot()

    def snapshot(self) -> Snapshot:
        """The last published state; immutable. It is made when it is first asked for: of most nobody does."""
        published = self._published
        made = published.made
        if made is None:
            made = published.made = self._snapshot_of(published)
        return made

    def events(self) -> Sequence[Event]:
        """The last events, oldest first."""
        return self.log.all()

    def samples(self) -> Sequence[SampleBlock]:
        """The last samples, tick by tick; see `DriveView`."""
        return self.ring.blocks()

    def request_reset(self) -> None:
        """Forget what was learned; carried out by the worker before the next samples."""
        self._estimation.request_reset()

    def reconfigure(self, config: DriveConfig) -> None:
        """See `Estimation.reconfigure`."""
        self._estimation.reconfigure(config)

    def request_model(self, effects: Sequence[str], start: StartValues) -> Future[ModelChange]:
        """Go over to another model while the drive runs; see `DriveView`."""
        request = self._estimation.diagnoses.completed(checked_request(effects, start))
        if self._estimation.config.estimation.adopt == "never":
            raise RefusedError('the model of this drive is fixed: its configuration says adopt = "never"')
        return self._estimation.change_model(request)

    @property
    def diagnosis(self) -> DiagnosisView:
        """The last diagnosis, and what can be done now."""
        return self._estimation.diagnoses.view()

    def request_diagnosis(self) -> None:
        """Begin one; see `DriveView`."""
        self._estimation.diagnoses.request()

    # -- worker thread ---------------------------------------------------------------------------------------

    @property
    def preparing(self) -> bool:
        """An estimator is being made, its plant compiled: that may take ten seconds. Any thread."""
        return self._estimation.preparing

    def work(self) -> bool:
        """Process what has arrived, so much in a round, and publish. Returns whether there were samples."""
        was_reset = self._estimation.carry_out_requests()
        told = [] if self.reader.driver.can_wait else self._relieve()
        self.log.tell(told)
        blocks = self.reader.queue.take(self._round_samples)
        if blocks:
            self._sample_time = time.time() - self.reader.queue.waited_s(time.monotonic())
            began_s = time.thread_time()
            self._estimation.take(blocks)
            self._bound_round(sum(map(len, blocks)), time.thread_time() - began_s)
        self._follow_link(bool(blocks or told) or was_reset)
        self._estimation.was_published(self._sample_time)
        return bool(blocks)

    def _relieve(self) -> list[Message]:
        return self._load.relieve(self.reader.queue, time.monotonic(), time.process_time(), held_up=self.held_up)

    def _bound_round(self, samples: int, used_s: float) -> None:
        """
        Args:
            samples: of the last round.
            used_s: CPU time that it took.
        """
        self._used_s += used_s
        self._round_samples = min(_ROUND_SAMPLES, samples * _ROUND_S / max(used_s, 1e-9))

    @property
    def starts(self) -> bool:
        """Its first samples may yet be gone over again, which takes long. Any thread."""
        return self._estimation.worked_s < _START_S and self._used_s < _START_CPU_S

    def tell_waiting(self, before: int) -> None:
        """Say so, once, where its samples wait for others' turns that take long. Whoever turns the drives, between two
        turns.

        Args:
            before: so many drives have theirs first.
        """
        if told := self._load.wait(self.reader.queue, time.monotonic(), before):
            self.log.tell(told)
            self._published = self._publish()

    def offer_state(self) -> None:
        """Lay out what is worth keeping for `save_offered`, if the drive is well and there is something. Worker thread:
        the pipeline is its own."""
        if self._link.connection == "connected":
            self._estimation.offer_state()

    def save_offered(self) -> None:
        """Write what was laid out. Saver thread: a disk may be slow."""
        self._estimation.keeper.write()

    @property
    def problem(self) -> str | None:
        """What is wrong with this drive's part of the daemon (not with the drive), in words."""
        return f"drive {self.name}: its state cannot be saved" if self._estimation.keeper.unwritable else None

    def _follow_link(self, changed: bool) -> None:
        """Publish when something changed; say once when the drive falls silent or speaks again."""
        link = self.reader.link
        silent = link.connection == "silent"
        if silent and not self._was_silent:
            self.log.add("silent", "drive is connected but sends no samples")
        elif self._was_silent and link.connection == "connected":
            self.log.add("speaking", "drive sends samples again")
        self._was_silent = silent or (self._was_silent and link.connection != "connected")
        if changed or link != self._link:
            self._link = link
            self._published = self._publish()
            if self._sample_time is not None and self.history.is_due(self._sample_time):
                self.history.append(self.snapshot())

    def _publish(self) -> _Published:
        behind_s = self.reader.queue.waited_s(time.monotonic()) if self._load.behind else 0.0
        return _Published(self._sample_time, self._link, self._estimation.now, self._load.overloaded, behind_s)

    def _snapshot_of(self, published: _Published) -> Snapshot:
        estimate, link = self._estimation.record(published.now), published.link
        if estimate is not None and link.connection != "connected":
            estimate = _stale(estimate, link)
        return Snapshot(
            drive=self.name,
            driver=self.driver,
            time=published.sample_time,
            connection=link.connection,
            reason=link.reason,
            estimate=estimate,
            counters=self._counters(),
            truth=self.reader.driver.truth(),
            overloaded=published.overloaded,
            behind_s=published.behind_s,
        )

    def _counters(self) -> dict[str, int]:
        """Totals of driver, queue and pipeline."""
        c, queue = self.reader.driver.counters, self.reader.queue
        return {
            "samples": c.samples,
            "samples_lost": c.samples_lost + queue.dropped,
            "queue_dropped": queue.dropped,
            "queue_samples": queue.samples,
            "samples_repeated": c.samples_repeated + self._estimation.repeated,
            "frames": c.frames,
            "crc_errors": c.crc_errors,
            "framing_errors": c.framing_errors,
            "unknown_frames": c.unknown_frames,
            "device_restarts": c.device_restarts,
            "reconnects": self.reader.reconnects,
            "pipeline_failures": self._estimation.failures,
            **c.extra,
        }


def _stale(estimate: Estimate, link: Link) -> Estimate:
    """The last estimate of a drive that does not speak now: values stay, their status says so."""
    why = link.reason or "the drive is not connected"
    if link.connection == "ended":
        return estimate
    parameters = tuple(replace(p, status="invalid", reason=why) for p in estimate.parameters)
    return replace(estimate, parameters=parameters)
