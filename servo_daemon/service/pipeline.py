"""Samples in, estimates out: the one object that the live daemon, `replay` and the tests run alike.

Pure: no I/O, no wall clock, no randomness. The same samples give bit-identical estimates however they are cut into
blocks (see `service/stream.py`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

import numpy as np

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.estimators.tracker import Tracker
from servo_daemon.samples import SampleBlock, concatenate
from servo_daemon.service import publish
from servo_daemon.service.publish import Publisher, SavedState
from servo_daemon.service.snapshot import Estimate
from servo_daemon.service.stream import TickCutter

log = logging.getLogger(__name__)


class Pipeline:
    """One drive's estimators.

    Args:
        config: the drive's configuration; its driver and options are not looked at.
        info: resolutions, where the driver knows them.
        saved: knowledge from an earlier run, already checked.
    """

    def __init__(self, config: DriveConfig, info: DriveInfo | None = None, saved: SavedState | None = None) -> None:
        self._config, self._info, self._saved = config, info, saved
        self._tracker: Tracker | None = None
        self._channels: tuple[str, ...] = ()
        self._cutter = TickCutter()
        self._tick: list[SampleBlock] = []
        self._publisher = Publisher(config)
        self._published: Estimate | None = None
        self._samples = 0
        self.samples_repeated = 0  # those without a time of their own
        self.messages: list[tuple[str, str, Mapping[str, float | int | str | None]]] = []

    def reset(self) -> None:
        """Forget everything learned, the saved state included."""
        self._saved = None
        self._tracker = None
        self._channels = ()
        self._published = None
        self._cutter = TickCutter()
        self._tick = []

    def learn_info(self, info: DriveInfo) -> None:
        """The driver has found out more (a description frame): used from the next start of the filter on."""
        self._info = info
        if self._tracker is not None:
            self._tracker.resolutions = publish.resolutions(self._config, info)

    def process(self, block: SampleBlock, *, rows: bool = True) -> list[Estimate]:
        """Take samples; returns one estimate per tick that they completed, in order.

        Args:
            rows: False: return nothing. The live daemon asks for `current` instead and saves the work.
        """
        if block.channels != self._channels:
            self._begin(block.channels)
        estimates = []
        restarts, repeated = self._cutter.restarts, self._cutter.repeated
        for segment in self._cutter.cut(block):
            if segment.closes_tick and self._tick:
                self._close_tick()
                if rows:
                    estimates.append(self._publish())
            assert self._tracker is not None
            self._tracker.take(segment.block)
            self._tick.append(segment.block)
            self._samples += len(segment.block)
        self.samples_repeated += self._cutter.repeated - repeated
        if self._cutter.restarts > restarts:
            text = "device time began anew: the device restarted; its parameters are kept"
            self.messages.append(("device_restarted", text, {"restarts": self._cutter.restarts}))
        return estimates

    def finish(self) -> Estimate | None:
        """At the end of a finite source: the estimate after the last, incomplete tick; None if there is none."""
        if not self._tick:
            return None
        self._close_tick()
        return self._publish()

    def current(self) -> Estimate | None:
        """The record after the very last sample, between ticks too; None before the first sample. Time, state and
        count are of that sample, the parameters of the last tick."""
        if self._tracker is None or self._tracker.last_s is None:
            return None
        return self._publish()

    def save(self) -> SavedState | None:
        """What is worth keeping over a restart; None unless the filter is well."""
        if self._tracker is None:
            return None
        kept = self._tracker.worth_keeping()
        if kept is None:
            return None
        return SavedState(
            self._config.model,
            kept.names,
            tuple(float(v) for v in kept.mean),
            tuple(tuple(float(c) for c in row) for row in kept.covariance),
        )

    def _begin(self, channels: tuple[str, ...]) -> None:
        if self._tracker is not None:
            log.warning("drive %s: channels changed to %s: starting over", self._config.name, ", ".join(channels))
        self._channels = channels
        self._published = None
        self._tick = []
        self._cutter = TickCutter()
        self._tracker = Tracker(
            channels,
            publish.tracker_settings(self._config),
            publish.resolutions(self._config, self._info),
            publish.prior(self._config, self._saved),
        )

    def _close_tick(self) -> None:
        assert self._tracker is not None
        self.messages += self._tracker.close_tick(concatenate(self._tick))
        self._tick = []
        self._published = None

    def _publish(self) -> Estimate:
        assert self._tracker is not None
        if self._published is None:
            self._published = self._publisher.estimate(self._tracker, self._samples)
        elif self._published.time_s != self._tracker.last_s:
            self._published = publish.moved_on(self._published, self._tracker, self._samples)
        return self._published


def all_finite(estimate: Estimate) -> bool:
    """Whether every published number is a number: the service's last line of defence, and the tests'."""
    numbers = [v for p in estimate.parameters for v in (p.value, p.std) if v is not None]
    numbers += [v for v in estimate.state.values() if v is not None]
    return bool(np.isfinite(numbers).all()) if numbers else True
