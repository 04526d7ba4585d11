"""When the time until a limit is short enough to be told."""

from __future__ import annotations

from servo_daemon.trend.records import Trend
from servo_daemon.trend.series import YEAR_D


def is_near(trend: Trend, warn_before_d: float) -> bool:
    """Whether the limit may be reached that soon: by the near end of the 80 % interval."""
    years = trend.years
    return years is not None and years.low is not None and years.low * YEAR_D < warn_before_d
