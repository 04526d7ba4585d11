"""What is published of the ageing of a drive's parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from servo_daemon.config_texts import UNIT_S
from servo_daemon.trend.records import Trend

#: Times of trends are days since the epoch.
DAY_S = UNIT_S["d"]


@dataclass(frozen=True, slots=True)
class DriveTrends:
    """Of one drive.

    Attributes:
        time: when they were found, UTC, seconds since the epoch; None: not yet.
        reason: why there are none, in words.
        warn_before_d: `warn_before`, days.
        trends: by parameter, times in days since the epoch.
        near: parameters whose limit may be reached within `warn_before`.
    """

    time: float | None = None
    reason: str | None = "they are found from the history, a minute after the start and then every hour"
    warn_before_d: float = 180.0
    trends: Mapping[str, Trend] = field(default_factory=dict)
    near: frozenset[str] = frozenset()
