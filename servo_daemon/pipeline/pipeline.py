"""Samples in, estimates out: the one object that the live daemon, `replay` and the tests run alike.

Pure: no I/O, no wall clock, no randomness. The same samples give bit-identical estimates however they are cut into
blocks (see `pipeline/stream.py`).
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.pipeline import publish
from servo_daemon.pipeline.handover import Handover, Successor
from servo_daemon.pipeline.link.current_timing import CurrentTiming
from servo_daemon.pipeline.link.measured_link import MeasuredLink
from servo_daemon.pipeline.model_change import ModelRequest, change_message
from servo_daemon.pipeline.publish import Publisher, SavedState
from servo_daemon.pipeline.refresher import Refresher
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.pipeline.stream import TickCutter
from servo_daemon.pipeline.views import Moment, State, last_temperature
from servo_daemon.published.snapshot import Estimate
from servo_daemon.samples import SampleBlock, concatenate
from servo_daemon.signal_meaning import SignalMeaning
from servo_daemon.tracking.plan.settings import Message
from servo_daemon.tracking.plant_tracker import make_tracker
from servo_daemon.tracking.tracker import Tracker

if TYPE_CHECKING:
    from servo_daemon.learning.model.model import LearnedModel

log = logging.getLogger(__name__)


class Pipeline:
    """One drive's estimators.

    Args:
        config: the drive's configuration; its driver and options are not looked at.
        info: resolutions, where the driver knows them.
        saved: knowledge from an earlier run, already checked.
        ring: where the samples of every tick are kept for a while, in a DC motor's units.
        meaning: of the drive's signals; None: as the configuration has it.

    Attributes:
        config: with the model as it is now; may be exchanged for one that is the same to the estimators.
        channels: of the last samples; empty before the first.
        samples_repeated: those without a time of their own.
        preparing: a tracker is being made.
        messages: what there is to tell; whoever tells it clears them.
    """

    def __init__(
        self,
        config: DriveConfig,
        info: DriveInfo | None = None,
        saved: SavedState | None = None,
        ring: SampleRing | None = None,
        meaning: SignalMeaning | None = None,
    ) -> None:
        self.meaning = meaning or config.signals.meaning()
        self._link: MeasuredLink | None = None
        self._timing: CurrentTiming | None = None
        self.config, self._info, self._saved, self._ring = config, info, saved, ring
        self._tracker: Tracker | None = None
        self.channels: tuple[str, ...] = ()
        self._cutter = TickCutter()
        self._tick: list[SampleBlock] = []
        self._driven: list[SampleBlock] = []  # the same as the trackers take them, where that is not the same
        self._publisher = Publisher(config)
        self._published: Estimate | None = None
        self._handover = Handover(self._tracker_for)
        self._learned: LearnedModel | None = None
        self._refresher: Refresher | None = None
        self._samples = 0
        self._last_s = 0.0  # of the last sample
        self._temperature_C: float | None = None  # the last that was measured
        self.samples_repeated = 0
        self.preparing = False
        self.messages: list[Message] = []

    @property
    def sample_period_s(self) -> float | None:
        """Of the last tick, device time; None before the first."""
        return None if self._tracker is None else self._tracker.sample_period_s

    def use_learned(self, model: LearnedModel | None) -> None:
        """The model that refreshes the estimates from the next tick on, if it was trained for this drive's effects;
        None: no more."""
        self._learned = model
        self._begin_refresher()

    def _begin_refresher(self) -> None:
        model = self._learned
        # (A learned model's features are those of a held voltage.)
        fits = model is not None and model.spec.effects == self.config.model and not self.meaning.follows_current
        names = publish.published_names(self.config)
        every_s = self.config.estimation.refresh_every_s
        self._refresher = Refresher(model, names, every_s) if model is not None and fits else None
        self._published = None

    def reset(self, config: DriveConfig | None = None) -> None:
        """Forget everything learned, the saved state included.

        Args:
            config: with which to begin again; None: the same.
        """
        if config is not None:
            self._configure(config)
        self._saved = None
        self._handover.clear()
        self._tracker = None
        self.channels = ()
        self._tick = []

    def prepare(self, config: DriveConfig) -> Tracker | None:
        """A tracker for `change_model`, its plant compiled; None while the channels are not known. Any thread, and this
        one may take ten seconds."""
        return self._tracker_for(config) if self.channels else None

    def change_model(self, request: ModelRequest, config: DriveConfig, prepared: Tracker | None) -> None:
        """Go over to another model: from the next tick on a filter with it runs beside the present one, begins with
        what that one knows, and takes its place once it has settled (about a second). Before the first samples at once.

        Args:
            config: the drive's with that model.
            prepared: by `prepare`; None: made here.
        """
        if self._tracker is None:
            self.messages.append(change_message(self.config.model, config.model))
            self._configure(config)
            self._saved = None
        else:
            self._handover.ask(request, config, prepared)

    def learn_info(self, info: DriveInfo) -> None:
        """The driver has found out more (a description frame): used from the next start of the filter on."""
        self._info = info
        if self._tracker is not None:
            self._tracker.resolutions = publish.resolutions(self.config, info)

    def process(self, block: SampleBlock, *, rows: bool = True) -> list[Estimate]:
        """Take samples; returns one estimate per tick that they completed, in order.

        Args:
            rows: False: return nothing. The live daemon asks for `now` instead and saves the work.
        """
        block = self.meaning.converted(block)
        if block.channels != self.channels:
            self._begin(block.channels)
        estimates = []
        restarts, repeated = self._cutter.restarts, self._cutter.repeated
        segments = self._cutter.cut(block)
        last = max((k for k, segment in enumerate(segments) if segment.closes_tick), default=-1)
        for k, segment in enumerate(segments):
            if segment.closes_tick and self._tick:
                self._close_tick()
                # At the tick's end, before the filter takes what came with it in one block: what is published must not
                # depend on how the samples came.
                # (Nor may what the next ticks keep of it.)
                if rows:
                    estimates += [record for record in (self.current(),) if record is not None]
                elif self._tracker is not None and (k == last or self._tracker.is_calm):
                    self.now()
            self._take(segment.block)
            self._samples += len(segment.block)
        self.samples_repeated += self._cutter.repeated - repeated
        if self._cutter.restarts > restarts:
            text = "device time began anew: the device restarted; its parameters are kept"
            self.messages.append(("device_restarted", text, {"restarts": self._cutter.restarts}))
        return estimates if rows else []

    def _take(self, block: SampleBlock) -> None:
        assert self._tracker is not None
        driven = block
        if self._link is not None:
            driven = self._link.driven(block)
            self._driven.append(driven)
        self._tracker.take(driven)
        self._handover.take(driven)
        self._last_s = float(block.time_s[-1])
        self._temperature_C = last_temperature(block, self._temperature_C)
        self._tick.append(block)

    def finish(self) -> Estimate | None:
        """At the end of a finite source: the estimate after the last, incomplete tick; None if there is none."""
        if not self._tick:
            return None
        self._close_tick()
        return self.current()

    def current(self) -> Estimate | None:
        """The record after the very last sample, between ticks too; None before the first sample. Time, state and
        count are of that sample, the parameters of the last tick."""
        now = self.now()
        return None if now is None else now.estimate()

    def now(self) -> Moment | None:
        """What `current` is made from."""
        if self._tracker is None or self._tracker.last_s is None:
            return None
        return Moment(self._of_tick(), self._last_s, self._samples, State.of(self._tracker), self._temperature_C)

    def save(self) -> SavedState | None:
        """What is worth keeping over a restart; None unless the filter is well."""
        if self._tracker is None:
            return None
        kept = self._tracker.worth_keeping()
        if kept is None:
            return None
        covariance = tuple(tuple(float(c) for c in row) for row in kept.covariance)
        return SavedState(self.config.model, kept.names, tuple(float(v) for v in kept.mean), covariance)

    def _begin(self, channels: tuple[str, ...]) -> None:
        if self._tracker is not None:
            log.warning("drive %s: channels changed to %s: starting over", self.config.name, ", ".join(channels))
        self.channels = channels
        self._published = None
        self._tick, self._driven = [], []
        self._cutter = TickCutter()
        linked = self.meaning.follows_current and "voltage_V" in channels
        self._link = MeasuredLink(self.config, self.meaning) if linked else None
        timed = linked or self.meaning.measures_voltage
        self._timing = CurrentTiming(self.meaning, torques=not linked) if timed else None
        self.preparing = True
        try:
            self._tracker = self._tracker_for(self.config, self._saved)
        finally:
            self.preparing = False
        self._begin_refresher()
        if (config := self._handover.config) is not None:
            self._take_over(Successor(config, self._tracker_for(config)))

    def _tracker_for(self, config: DriveConfig, saved: SavedState | None = None) -> Tracker:
        channels = self.channels
        if self._link is not None:
            channels = tuple(c for c in channels if c != "voltage_V")
            config = self._link.filter_config(config)
        mean = self._link is not None and self.meaning.current == "mean"
        return make_tracker(
            channels,
            replace(publish.tracker_settings(config), mean_current=mean),
            publish.resolutions(config, self._info),
            publish.prior(config, saved),
        )

    def _configure(self, config: DriveConfig) -> None:
        self.config, self._publisher, self._published = config, Publisher(config), None
        self._begin_refresher()

    def _close_tick(self) -> None:
        assert self._tracker is not None
        tick = concatenate(self._tick)
        driven = tick if self._link is None else concatenate(self._driven)
        told = self._tracker.close_tick(driven)
        self.messages += told
        stays = self._tracker.waits
        if self._refresher is not None:
            view = self._refresher.view
            self.messages += self._refresher.take(tick, self._tracker, told)
            stays &= self._refresher.view is view
        if self._ring is not None:
            self._ring.append(tick)
        self._tick, self._driven = [], []
        if not stays:
            self._published = None
        if (successor := self._handover.close_tick(driven)) is not None:
            self._take_over(successor)
        if self._timing is not None:
            self._timing.take(tick)
        if self._link is not None and self._link.close_tick(tick):
            self._tracker = self._tracker_for(self.config, self._saved)  # K is known: the filter can begin
        if (successor := self._handover.begin(self._tracker)) is not None:
            self._take_over(successor)

    def _take_over(self, successor: Successor) -> None:
        assert self._tracker is not None
        tracker = successor.tracker
        tracker.watch.gated += self._tracker.watch.gated
        tracker.restarts += self._tracker.restarts
        before, self._tracker = self.config, tracker
        self._handover.clear()
        self._configure(successor.config)
        self.messages += [change_message(before.model, successor.config.model), *successor.told]

    def _of_tick(self) -> Estimate:
        """The record of the last tick that was judged, as of when it was first asked for."""
        assert self._tracker is not None
        if self._published is None:
            self._published = self._publisher.estimate(self._tracker, self._samples, self._refresher)
            if self._link is not None:
                self._published = self._link.instead(self._published)
            if self._timing is not None:
                self._published = self._timing.widened(self._published)
            self._published = publish.with_equivalents(self._published, self.meaning)
            self._published = replace(self._published, time_s=self._last_s)
        return self._published
