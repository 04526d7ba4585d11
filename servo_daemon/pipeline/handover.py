"""From the tracker of one model to that of another, which sees the same samples until it can speak for the drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.model_change import ModelRequest
from servo_daemon.samples import SampleBlock
from servo_daemon.tracking.plan.settings import Message
from servo_daemon.tracking.plant_tracker import PlantTracker
from servo_daemon.tracking.succession import transferred
from servo_daemon.tracking.tracker import Tracker

#: A filter with another model that has not settled by then speaks for the drive all the same, ticks (five seconds;
#: chosen; not tried).
_TICKS_TO_TAKE_OVER = 50


@dataclass(slots=True)
class Successor:
    """A tracker with another model.

    Attributes:
        config: the drive's with that model.
        told: what it has to say, of interest once it speaks for the drive.
    """

    config: DriveConfig
    tracker: Tracker
    ticks: int = 0
    told: list[Message] = field(default_factory=list)


class Handover:
    """The change of one drive from its tracker to the one of another model.

    Args:
        make: a tracker for a configuration.
    """

    def __init__(self, make: Callable[[DriveConfig], Tracker]) -> None:
        self._make = make
        self._wanted: tuple[ModelRequest, DriveConfig, Tracker | None] | None = None
        self._successor: Successor | None = None

    @property
    def config(self) -> DriveConfig | None:
        """The drive's with the model that is to come; None: none is."""
        if self._successor is not None:
            return self._successor.config
        return None if self._wanted is None else self._wanted[1]

    def clear(self) -> None:
        """No other model is to come."""
        self._wanted = self._successor = None

    def ask(self, request: ModelRequest, config: DriveConfig, prepared: Tracker | None) -> None:
        """Another model is to come.

        Args:
            config: the drive's with that model.
            prepared: its tracker; None: made here.
        """
        self._wanted, self._successor = (request, config, prepared), None

    def take(self, block: SampleBlock) -> None:
        """Samples as the present tracker takes them."""
        if self._successor is not None:
            self._successor.tracker.take(block)

    def close_tick(self, tick: SampleBlock) -> Successor | None:
        """A tick of the filter that will take over; it is returned when it can."""
        s = self._successor
        if s is None:
            return None
        s.told += s.tracker.close_tick(tick)
        s.ticks += 1
        return s if s.tracker.settled or s.ticks >= _TICKS_TO_TAKE_OVER else None

    def begin(self, present: Tracker) -> Successor | None:
        """What was asked for begins, at the end of a tick, so that the estimates do not depend on how the samples came
        in blocks. Returned is what can take over at once, having nothing to take over."""
        if self._wanted is None:
            return None
        (request, config, prepared), self._wanted = self._wanted, None
        fits = prepared is not None and prepared.channels == present.channels
        tracker = prepared if prepared is not None and fits else self._make(config)
        transfer = transferred(present, tracker, request.start, request.origin_s)
        if transfer is None or not isinstance(tracker, PlantTracker):
            return Successor(config, tracker)
        tracker.begin_with(transfer)
        self._successor = Successor(config, tracker)
        return None
