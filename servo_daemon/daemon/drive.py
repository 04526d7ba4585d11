"""Everything one drive is at run time: reader, pipeline, history, events, and the snapshot the API reads."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

from drivers.base import DriveInfo, Driver
from servo_daemon.config import DriveConfig
from servo_daemon.config.changes import looked_up
from servo_daemon.daemon.diagnosis.coordinator import DiagnosisCoordinator
from servo_daemon.daemon.diagnosis.runner import DiagnosisRunner
from servo_daemon.daemon.drive_parts import line_counters, same_channels, stale, with_onboard
from servo_daemon.daemon.learning_coordinator import Subscription
from servo_daemon.daemon.lines.ports import Ports
from servo_daemon.daemon.lines.reader import Link, Reader
from servo_daemon.daemon.load import LoadWatch
from servo_daemon.daemon.model_coordinator import ModelCoordinator
from servo_daemon.daemon.state_keeper import StateKeeper
from servo_daemon.errors import NumericalError, RefusedError
from servo_daemon.pipeline.controller import loop_facts
from servo_daemon.pipeline.drive_warnings import DriveWarnings
from servo_daemon.pipeline.event_log import EventLog
from servo_daemon.pipeline.model_change import ModelRequest, change_message, checked_request, describe_model
from servo_daemon.pipeline.pipeline import Pipeline, all_finite
from servo_daemon.pipeline.publish import SavedState, published_parameters
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.published.diagnosis_state import DiagnosisView
from servo_daemon.published.history import HistoryRing
from servo_daemon.published.knowledge import LoopFacts
from servo_daemon.published.snapshot import AlarmLimit, Estimate, Event, ParameterEstimate, Snapshot
from servo_daemon.published.trends import DriveTrends
from servo_daemon.published.view import ModelChange, StartValues, initial_parameters
from servo_daemon.samples import SampleBlock, concatenate
from servo_daemon.signal_meaning import SignalMeaning
from servo_daemon.tracking.plan.settings import Message

log = logging.getLogger(__name__)

#: Samples of a round, in whole blocks: half a second of a drive at a kilohertz. Between rounds it is seen whether the
#: worker keeps up, and what was found is published.
_ROUND_SAMPLES = 500
#: A pipeline that fails again and again is told this often, s; every failure is counted.
_FAILURE_SAID_EVERY_S = 60.0
#: So much of its samples, s, a drive starts: the last look back at its first samples ends by then
#: (`tracking/restart/maximum_likelihood.py`).
_START_S = 20.0


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
        self.config = config
        self.subscription = subscription
        self.history = HistoryRing()
        self._keeper = StateKeeper(state_dir, config)
        self.ring = SampleRing(config.estimation.ring_s)
        self.log = EventLog(config.name)
        self.reader = Reader(driver, wake, self.log.add, ports)
        self._model_changes = ModelCoordinator(config.name, wake)
        self.active = config  # with the model as it is now
        self._pipeline: Pipeline | None = None
        self._identity: str | None = None
        self.info: DriveInfo = driver.info
        self.estimate: Estimate | None = None
        self.trends = DriveTrends()  # written by the coordinator of trends
        self._sample_time: float | None = None
        self._failures = self._repeated = 0
        self._quiet_until = 0.0
        self._reset_wanted = self._changed = False
        self._wanted_config: DriveConfig | None = None
        self._worked_s = 0.0  # so much of its samples, device time
        self.others_start = False  # some wait for their turn; told by whoever turns the drives
        self._was_silent = False
        self._link: Link = self.reader.link
        self._warnings = DriveWarnings(config)
        self._load = LoadWatch()
        self._diagnoses = DiagnosisCoordinator(self, self.ring, self.log, runner or DiagnosisRunner())
        self.log.tell(self._warnings.at_start)
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
        return self.active.model

    @property
    def meaning(self) -> SignalMeaning:
        """Of its signals: as configured, and else as the driver says."""
        return self.config.signals.meaning(self.reader.driver.meaning)

    @property
    def initial_parameters(self) -> Sequence[ParameterEstimate]:
        """What is published before the first samples."""
        return initial_parameters(published_parameters(self.active), self.active.nominal)

    @property
    def loop(self) -> LoopFacts:
        """What is known of the control loop around this drive."""
        return loop_facts(self.config, self.reader.driver.info.counts_per_rev)

    @property
    def limits(self) -> Sequence[AlarmLimit]:
        """Those whose alarms can ring."""
        return self._warnings.limits

    def snapshot(self) -> Snapshot:
        """The last published state; immutable."""
        return self._snapshot

    def events(self) -> Sequence[Event]:
        """The last events, oldest first."""
        return self.log.all()

    def samples(self) -> Sequence[SampleBlock]:
        """The last samples, tick by tick; see `DriveView`."""
        return self.ring.blocks()

    def request_reset(self) -> None:
        """Forget what was learned; carried out by the worker before the next samples."""
        self._reset_wanted = True

    def reconfigure(self, config: DriveConfig) -> None:
        """Another configuration, whose limits, gains and answers to a diagnosis are to count (`looked_up`); carried out
        by the worker before the next samples."""
        self._wanted_config = config

    def request_model(self, effects: Sequence[str], start: StartValues) -> Future[ModelChange]:
        """Go over to another model while the drive runs; see `DriveView`."""
        request = self._diagnoses.completed(checked_request(effects, start))
        if self.config.estimation.adopt == "never":
            raise RefusedError('the model of this drive is fixed: its configuration says adopt = "never"')
        return self.change_model(request)

    @property
    def diagnosis(self) -> DiagnosisView:
        """The last diagnosis, and what can be done now."""
        return self._diagnoses.view()

    def request_diagnosis(self) -> None:
        """Begin one; see `DriveView`."""
        self._diagnoses.request()

    def change_model(self, request: ModelRequest) -> Future[ModelChange]:
        """Have a checked request carried out by the worker, between two blocks. Any thread.

        Raises:
            BusyError: the last one is not done yet.
        """
        return self._model_changes.ask(request, request.configure(self.config), self._pipeline)

    # -- worker thread ---------------------------------------------------------------------------------------

    @property
    def preparing(self) -> bool:
        """An estimator is being made, its plant compiled: that may take ten seconds. Any thread."""
        return self._pipeline is not None and self._pipeline.preparing

    def work(self) -> bool:
        """Process what has arrived, so much in a round, and publish. Returns whether there were samples."""
        self._reconfigure()
        was_reset = self._reset_wanted
        if was_reset:
            self._reset()
        self._begin_model_change()
        told = [] if self.reader.driver.can_wait else self._relieve()
        self.log.tell(told)
        blocks = self.reader.queue.take(_ROUND_SAMPLES)
        if blocks:
            self._sample_time = time.time() - self.reader.queue.waited_s(time.monotonic())
            try:
                self._process(blocks)
            except Exception:  # one drive's trouble must not stop the others
                self._fail()
        self._follow_link(bool(blocks or told) or was_reset)
        if self._changed:  # now that the first estimate of the new model is published
            self._changed = False
            self._model_changes.done(self._sample_time)
        return bool(blocks)

    def _relieve(self) -> list[Message]:
        return self._load.relieve(
            self.reader.queue, time.monotonic(), time.process_time(), drives_start=self.others_start
        )

    @property
    def starts(self) -> bool:
        """Its first samples may yet be gone over again, which takes long. Any thread."""
        return self._worked_s < _START_S

    def tell_waiting(self, before: int) -> None:
        """Say so, once, where its samples wait for others' turns that take long. Whoever turns the drives, between two
        turns.

        Args:
            before: so many drives have theirs first.
        """
        if told := self._load.wait(self.reader.queue, time.monotonic(), before):
            self.log.tell(told)
            self._snapshot = self._make_snapshot()

    def offer_state(self) -> None:
        """Lay out what is worth keeping for `save_offered`, if the drive is well and there is something. Worker thread:
        the pipeline is its own."""
        if self._pipeline is None or self._identity is None or self._link.connection != "connected":
            return
        self._keeper.offer(self._identity, self._pipeline.save(), self.active)

    def save_offered(self) -> None:
        """Write what was laid out. Saver thread: a disk may be slow."""
        self._keeper.write()

    @property
    def problem(self) -> str | None:
        """What is wrong with this drive's part of the daemon (not with the drive), in words."""
        return f"drive {self.name}: its state cannot be saved" if self._keeper.unwritable else None

    def _process(self, blocks: list[SampleBlock]) -> None:
        pipeline = self._pipeline_for_device()
        repeated = pipeline.samples_repeated
        for run in same_channels(blocks):
            pipeline.process(concatenate(run), rows=False)
            self._worked_s += float(run[-1].time_s[-1] - run[0].time_s[0])
        self._repeated += pipeline.samples_repeated - repeated
        estimate = pipeline.current()
        if estimate is not None and not all_finite(estimate):
            raise NumericalError("an estimate is not a number")
        self.log.tell(pipeline.messages)
        pipeline.messages.clear()
        if pipeline.config is not self.active:
            self._activate(pipeline.config)
            self._changed = True
        if self.subscription is not None:
            estimate = self._learn(self.subscription, pipeline, estimate)
        if estimate is not None:
            estimate, told = self._warnings.update(estimate)
            self.log.tell(told)
            self._diagnoses.watch(estimate)
        self.estimate = with_onboard(estimate, self.reader.driver.onboard, time.monotonic())

    def _learn(self, subscription: Subscription, pipeline: Pipeline, estimate: Estimate | None) -> Estimate | None:
        """Tell the coordinator what is needed, take what has come; the estimate with what is published until then."""
        subscription.follow(self.active, pipeline.channels, pipeline.sample_period_s)
        model = subscription.take()
        if model is not None:
            pipeline.use_learned(model)
            text = f"RF+GRNN model of {model.facts.get('motors')} simulated motors at work, in the shadow first"
            self.log.add("model_learned", text)
        if estimate is None or "grnn" in estimate.estimators:
            return estimate
        return replace(estimate, estimators={**estimate.estimators, "grnn": subscription.view})

    def _pipeline_for_device(self) -> Pipeline:
        """The pipeline of the device that is attached now; a new device starts from what is known of it."""
        info = self.reader.driver.info
        # Between two attachments a driver may not know yet who is there: what still waits in the queue is the last's.
        other = bool(self._identity) and bool(info.identity) and info.identity != self._identity
        if self._pipeline is None or other:
            if self._pipeline is not None:
                self.log.add("device_changed", f"another device is attached: {info.identity}")
                self.log.tell(self._warnings.forget("another device is attached"))
                self._model_changes.fail("another device was attached")
                self.ring.clear()
                self._activate(self.config)
            saved = self._keeper.load(info.identity)
            if saved is not None:
                self._restored(saved)
            self._pipeline = Pipeline(self.active, info, saved, self.ring, self.meaning)
            if self.subscription is not None:
                self.subscription.begin_again()
            self._identity, self.info = info.identity, info
        elif info != self.info:
            self._pipeline.learn_info(info)
            self._identity, self.info = info.identity or self._identity, info
        return self._pipeline

    def _restored(self, saved: SavedState) -> None:
        """Tell what was taken up from the last run; a model that was adopted then is the drive's again."""
        if saved.adopted is not None and self.active is self.config:  # else somebody has asked for another one by now
            self._activate(saved.adopted.configure(self.config, saved.model))
            self._keeper.knows(self.active)
            text = f"the model adopted in an earlier run: {describe_model(saved.model)}"
            self.log.add("model_restored", text, {"model": ",".join(saved.model)})
        if saved.names and saved.model == self.model:
            self.log.add("state_restored", "estimates of the last run restored")

    def _begin_model_change(self) -> None:
        pending = self._model_changes.take()
        if pending is None:
            return
        if self._pipeline is None:
            self.log.tell([change_message(self.model, pending.config.model)])
            self._activate(pending.config)
            self._model_changes.done(None)
        else:
            self._pipeline.change_model(pending.request, pending.config, pending.tracker)

    def _activate(self, config: DriveConfig) -> None:
        """From now on this is the drive's configuration: the user's, with another model."""
        config = looked_up(config, self.config)  # it may have been made before the last `reconfigure`
        if self._pipeline is not None:
            self._pipeline.config = config
        if config is self.active:
            return
        self.active = config
        self._diagnoses.model_changed()
        self.log.tell(self._warnings.follow(config))

    def _reconfigure(self) -> None:
        config, self._wanted_config = self._wanted_config, None
        if config is None:
            return
        before, own = self.active, self.active is self.config
        self.config = config
        self.active = config if own else looked_up(before, config)
        self._keeper.follow(self.config, before, self.active)
        if self._pipeline is not None:
            self._pipeline.config = self.active
        self.log.tell(self._warnings.reconfigure(self.active))

    def _fail(self) -> None:
        self._failures += 1
        now = time.monotonic()
        if now >= self._quiet_until:  # a failure that comes with every block must not fill the disk
            self._quiet_until = now + _FAILURE_SAID_EVERY_S
            log.exception("drive %s: the pipeline failed; it starts over", self.name)
            text = "the pipeline failed and starts over; the log has the details"
            self.log.add("pipeline_failed", text, {"failures": self._failures})
        if self._pipeline is not None:
            self._pipeline.reset()
        self._model_changes.fail("the pipeline failed and starts over")
        self.estimate = None

    def _reset(self) -> None:
        self._reset_wanted = False
        self._keeper.forget()
        if self._pipeline is not None:
            self._pipeline.reset(self.config)
        self._model_changes.fail("the estimates were reset")
        self._activate(self.config)
        self.estimate = None
        self.log.add("reset", "estimates reset by request")
        self.log.tell(self._warnings.forget("estimates were reset"))

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
            self._snapshot = self._make_snapshot()
            self.history.append(self._snapshot)

    # -- helpers ---------------------------------------------------------------------------------------------

    def _make_snapshot(self) -> Snapshot:
        estimate = self.estimate
        if estimate is not None and self._link.connection != "connected":
            estimate = stale(estimate, self._link)
        return Snapshot(
            drive=self.name,
            driver=self.driver,
            time=self._sample_time,
            connection=self._link.connection,
            reason=self._link.reason,
            estimate=estimate,
            counters=line_counters(self.reader, self._repeated, self._failures),
            truth=self.reader.driver.truth(),
            overloaded=self._load.overloaded,
            behind_s=self.reader.queue.waited_s(time.monotonic()) if self._load.behind else 0.0,
        )
