"""The pipeline of one drive through all that happens to it: devices that are attached, failures, resets, other
configurations and other models."""

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
from servo_daemon.daemon.learning_coordinator import Subscription
from servo_daemon.daemon.model_coordinator import ModelCoordinator
from servo_daemon.daemon.state_keeper import StateKeeper
from servo_daemon.errors import NumericalError
from servo_daemon.pipeline.drive_warnings import DriveWarnings
from servo_daemon.pipeline.event_log import EventLog
from servo_daemon.pipeline.model_change import ModelRequest, change_message, describe_model
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.pipeline.publish import SavedState
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.pipeline.views import Moment, with_onboard
from servo_daemon.published.snapshot import Estimate
from servo_daemon.published.view import ModelChange
from servo_daemon.samples import SampleBlock, concatenate
from servo_daemon.signal_meaning import SignalMeaning

log = logging.getLogger(__name__)

#: A pipeline that fails again and again is told this often, s; every failure is counted.
_FAILURE_SAID_EVERY_S = 60.0


class Estimation:
    """What one drive's samples say. `request_reset`, `reconfigure`, `change_model`, `preparing` and the attributes may
    be used from any thread, all else by the worker.

    Args:
        config: the drive.
        driver: what is attached.
        state_dir: where knowledge is kept over a restart; None: nowhere.
        events: the drive's.
        wake: called when there is work.
        runner: of diagnoses.
        subscription: where learned models come from; None: nowhere.

    Attributes:
        config: as the user wrote it; `active` with the model as it is now.
        info: of the device whose samples came last.
        now: the last moment, of which `record` makes an estimate.
        failures: of the pipeline; `repeated` the samples that it left out because they came twice.
        worked_s: so much of the drive's samples, device time.
    """

    def __init__(
        self,
        config: DriveConfig,
        driver: Driver,
        state_dir: Path | None,
        events: EventLog,
        wake: Callable[[], None],
        runner: DiagnosisRunner,
        subscription: Subscription | None,
    ) -> None:
        self.config = self.active = config
        self.info: DriveInfo = driver.info
        self.now: Moment | None = None
        self._judged: tuple[Estimate, Estimate] | None = None  # the last tick's record, and with what warns of it
        self.ring = SampleRing(config.estimation.ring_s)
        self.keeper = StateKeeper(state_dir, config)
        self.warnings = DriveWarnings(config)
        self.failures = self.repeated = 0
        self.worked_s = 0.0
        self._driver, self._events, self._subscription = driver, events, subscription
        self._pipeline: Pipeline | None = None
        self._identity: str | None = None
        self._model_changes = ModelCoordinator(config.name, wake)
        self._reset_wanted = self._changed = False
        self._wanted_config: DriveConfig | None = None
        self._quiet_until = 0.0
        self.diagnoses = DiagnosisCoordinator(self, self.ring, events, runner)
        events.tell(self.warnings.at_start)

    @property
    def meaning(self) -> SignalMeaning:
        """Of the drive's signals: as configured, and else as the driver says."""
        return self.config.signals.meaning(self._driver.meaning)

    @property
    def estimate(self) -> Estimate | None:
        """The last one; None before the first samples, and after a reset or a failure."""
        return self.record(self.now)

    def record(self, now: Moment | None) -> Estimate | None:
        """The estimate of a moment, with what the drive itself and the learning say beside it."""
        if now is None:
            return None
        estimate = now.estimate()
        if self._subscription is not None and "grnn" not in estimate.estimators:
            estimate = replace(estimate, estimators={**estimate.estimators, "grnn": self._subscription.view})
        return with_onboard(estimate, self._driver.onboard, time.monotonic())

    @property
    def preparing(self) -> bool:
        """An estimator is being made, its plant compiled: that may take ten seconds."""
        return self._pipeline is not None and self._pipeline.preparing

    def request_reset(self) -> None:
        """Forget what was learned; carried out before the next samples."""
        self._reset_wanted = True

    def reconfigure(self, config: DriveConfig) -> None:
        """Another configuration, whose limits, gains and answers to a diagnosis are to count (`looked_up`); carried out
        before the next samples."""
        self._wanted_config = config

    def change_model(self, request: ModelRequest) -> Future[ModelChange]:
        """Have a checked request carried out between two blocks.

        Raises:
            BusyError: the last one is not done yet.
        """
        return self._model_changes.ask(request, request.configure(self.config), self._pipeline)

    def carry_out_requests(self) -> bool:
        """What was asked for since the last samples. Returns whether the estimates were reset."""
        self._follow_config()
        was_reset = self._reset_wanted
        if was_reset:
            self._reset()
        self._begin_model_change()
        return was_reset

    def take(self, blocks: Sequence[SampleBlock]) -> None:
        """Work off what has arrived. Never raises: a pipeline that fails starts over."""
        try:
            self._process(blocks)
        except Exception:  # one drive's trouble must not stop the others
            self._fail()

    def was_published(self, time_s: float | None) -> None:
        """The last estimate is; with it a change of the model is done.

        Args:
            time_s: of it, UTC.
        """
        if self._changed:
            self._changed = False
            self._model_changes.done(time_s)

    def offer_state(self) -> None:
        """Lay out for the saver what is worth keeping, if there is something."""
        if self._pipeline is not None and self._identity is not None:
            self.keeper.offer(self._identity, self._pipeline.save(), self.active)

    def _process(self, blocks: Sequence[SampleBlock]) -> None:
        pipeline = self._pipeline_for_device()
        repeated = pipeline.samples_repeated
        for run in _same_channels(blocks):
            pipeline.process(concatenate(run), rows=False)
            self.worked_s += float(run[-1].time_s[-1] - run[0].time_s[0])
        self.repeated += pipeline.samples_repeated - repeated
        now = pipeline.now()
        fresh = now is not None and (self._judged is None or self._judged[0] is not now.tick)
        if now is not None and fresh and not now.tick.is_finite:
            raise NumericalError("an estimate is not a number")
        self._events.tell(pipeline.messages)
        pipeline.messages.clear()
        if pipeline.config is not self.active:
            self._activate(pipeline.config)
            self._changed = True
        if self._subscription is not None:
            self._learn(self._subscription, pipeline)
        if now is not None and fresh:
            estimate, told = self.warnings.update(now.estimate())
            self._events.tell(told)
            self.diagnoses.watch(estimate)
            self._judged = now.tick, estimate
        self.now = now if now is None or self._judged is None else replace(now, tick=self._judged[1])

    def _learn(self, subscription: Subscription, pipeline: Pipeline) -> None:
        """Tell the coordinator what is needed, take what has come."""
        subscription.follow(self.active, pipeline.channels, pipeline.sample_period_s)
        model = subscription.take()
        if model is not None:
            pipeline.use_learned(model)
            text = f"RF+GRNN model of {model.facts.get('motors')} simulated motors at work, in the shadow first"
            self._events.add("model_learned", text)

    def _pipeline_for_device(self) -> Pipeline:
        """The pipeline of the device that is attached now; a new device starts from what is known of it."""
        info = self._driver.info
        # Between two attachments a driver may not know yet who is there: what still waits in the queue is the last's.
        other = bool(self._identity) and bool(info.identity) and info.identity != self._identity
        if self._pipeline is None or other:
            if self._pipeline is not None:
                self._events.add("device_changed", f"another device is attached: {info.identity}")
                self._events.tell(self.warnings.forget("another device is attached"))
                self._model_changes.fail("another device was attached")
                self.ring.clear()
                self._activate(self.config)
            saved = self.keeper.load(info.identity)
            if saved is not None:
                self._restored(saved)
            self._pipeline = Pipeline(self.active, info, saved, self.ring, self.meaning)
            if self._subscription is not None:
                self._subscription.begin_again()
            self._identity, self.info = info.identity, info
        elif info != self.info:
            self._pipeline.learn_info(info)
            self._identity, self.info = info.identity or self._identity, info
        return self._pipeline

    def _restored(self, saved: SavedState) -> None:
        """Tell what was taken up from the last run; a model that was adopted then is the drive's again."""
        if saved.adopted is not None and self.active is self.config:  # else somebody has asked for another one by now
            self._activate(saved.adopted.configure(self.config, saved.model))
            self.keeper.knows(self.active)
            text = f"the model adopted in an earlier run: {describe_model(saved.model)}"
            self._events.add("model_restored", text, {"model": ",".join(saved.model)})
        if saved.names and saved.model == self.active.model:
            self._events.add("state_restored", "estimates of the last run restored")

    def _begin_model_change(self) -> None:
        pending = self._model_changes.take()
        if pending is None:
            return
        if self._pipeline is None:
            self._events.tell([change_message(self.active.model, pending.config.model)])
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
        self.diagnoses.model_changed()
        self._events.tell(self.warnings.follow(config))

    def _follow_config(self) -> None:
        config, self._wanted_config = self._wanted_config, None
        if config is None:
            return
        before, own = self.active, self.active is self.config
        self.config = config
        self.active = config if own else looked_up(before, config)
        self.keeper.follow(self.config, before, self.active)
        if self._pipeline is not None:
            self._pipeline.config = self.active
        self._events.tell(self.warnings.reconfigure(self.active))
        self._judged = None

    def _fail(self) -> None:
        self.failures += 1
        now = time.monotonic()
        if now >= self._quiet_until:  # a failure that comes with every block must not fill the disk
            self._quiet_until = now + _FAILURE_SAID_EVERY_S
            log.exception("drive %s: the pipeline failed; it starts over", self.config.name)
            text = "the pipeline failed and starts over; the log has the details"
            self._events.add("pipeline_failed", text, {"failures": self.failures})
        if self._pipeline is not None:
            self._pipeline.reset()
        self._model_changes.fail("the pipeline failed and starts over")
        self.now = self._judged = None

    def _reset(self) -> None:
        self._reset_wanted = False
        self.keeper.forget()
        if self._pipeline is not None:
            self._pipeline.reset(self.config)
        self._model_changes.fail("the estimates were reset")
        self._activate(self.config)
        self.now = self._judged = None
        self._events.add("reset", "estimates reset by request")
        self._events.tell(self.warnings.forget("estimates were reset"))


def _same_channels(blocks: Sequence[SampleBlock]) -> list[list[SampleBlock]]:
    """Neighbouring blocks that can be joined: the same channels, and no restart inside."""
    runs: list[list[SampleBlock]] = []
    for block in blocks:
        joins = runs and runs[-1][-1].channels == block.channels and runs[-1][-1].time_s[-1] < block.time_s[0]
        if joins:
            runs[-1].append(block)
        else:
            runs.append([block])
    return runs
