"""What warns of a drive's parameters: alarms, and the watches over its control loop's margins and its angle's scale."""

from __future__ import annotations

from dataclasses import replace

from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.alarms import Alarms
from servo_daemon.pipeline.controller import incomplete, loop_facts
from servo_daemon.pipeline.margin_watch import ALARM, MarginWatch
from servo_daemon.pipeline.scale_watch import ScaleWatch
from servo_daemon.published.snapshot import AlarmLimit, Estimate
from servo_daemon.tracking.plan.settings import Message


class DriveWarnings:
    """Makes warnings of one drive's estimates. Pure.

    Args:
        config: the drive's.

    Attributes:
        at_start: to be told once.
    """

    def __init__(self, config: DriveConfig) -> None:
        self._alarms, self._margins = Alarms(config), MarginWatch(loop_facts(config))
        self._scale = ScaleWatch(config)
        self.at_start: list[Message] = list(self._alarms.impossible)
        if (why := incomplete(config.controller)) is not None:
            self.at_start.append(("margin_impossible", f"margins cannot be watched: {why}", {}))

    @property
    def limits(self) -> tuple[AlarmLimit, ...]:
        """Those whose alarms can ring."""
        return self._alarms.limits

    def update(self, estimate: Estimate) -> tuple[Estimate, list[Message]]:
        """The estimate with what warns of it in its health record, and what begins or ends with it."""
        told = [*self._alarms.update(estimate), *self._margins.update(estimate), *self._scale.update(estimate)]
        ringing = [name for name in (self._alarms.active, ALARM if self._margins.low else None) if name]
        health = {**estimate.health, **self._margins.health, "alarms": ",".join(ringing) or None}
        if self._scale.hint is not None:
            health["scale_hint"] = self._scale.hint
        return replace(estimate, health=health), told

    def follow(self, config: DriveConfig) -> list[Message]:
        """The drive has another model."""
        before, self._alarms = self._alarms, Alarms(config)
        return self._alarms.follow(before)

    def reconfigure(self, config: DriveConfig) -> list[Message]:
        """The drive has other limits or gains: what rings goes on ringing, the margins are looked at anew."""
        why = "the configuration has changed"
        ended = self._margins.forget(why)
        alarms, started = self._alarms, DriveWarnings(config)
        self._alarms, self._margins, self._scale = started._alarms, started._margins, started._scale
        told = self._alarms.follow(alarms, why)
        return [*ended, *told, *(m for m in started.at_start if m[0] == "margin_impossible")]

    def forget(self, why: str) -> list[Message]:
        """What they were about is no longer known.

        Args:
            why: in words.
        """
        return [*self._alarms.forget(why), *self._margins.forget(why)]
