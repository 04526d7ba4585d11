"""The warning that a drive's angle is probably in another scale, live (`conditioning/angle_scale.py`)."""

from __future__ import annotations

from servo_daemon.conditioning.angle_scale import angle_hint
from servo_daemon.config import DriveConfig
from servo_daemon.parameters import KNOWN
from servo_daemon.published.snapshot import Estimate, ParameterEstimate
from servo_daemon.tracking.plan.settings import Message

#: A value is good enough to be compared once it is known so well, 1 σ (a third of what K may be off by).
_KNOWN_TO = 0.03


class ScaleWatch:
    """Of one drive. Pure: fed estimates, says it once.

    Args:
        config: the drive's.

    Attributes:
        hint: in words, as of the last estimate; None: nothing shows it.
    """

    def __init__(self, config: DriveConfig) -> None:
        self._nominal, self._gear = dict(config.nominal), config.signals.gear_ratio or 1.0
        self.hint: str | None = None
        self._told = False
        self._seen: tuple[ParameterEstimate, ...] | None = None

    def update(self, estimate: Estimate) -> list[Message]:
        """Look at an estimate; returns what there is to tell."""
        if not self._nominal or estimate.parameters is self._seen:
            return []
        self._seen = estimate.parameters
        good = {
            p.name: p.value
            for p in estimate.parameters
            if p.status in KNOWN and p.value and p.std is not None and p.std < _KNOWN_TO * abs(p.value)
        }
        self.hint = angle_hint(good, self._nominal, self._gear)
        if self.hint is None or self._told:
            return []
        self._told = True
        return [("scale_suspected", self.hint, {"time_s": estimate.time_s})]
