"""When the time until a limit is short enough to be told."""

from __future__ import annotations

from typing import Final

from servo_daemon.trend.records import Trend
from servo_daemon.trend.series import YEAR_D

#: Where the configuration does not say: half a year, in which a motor can be bought and a standstill planned.
WARN_BEFORE_D: Final = 180.0


def is_near(trend: Trend, warn_before_d: float) -> bool:
    """Whether the limit may be reached that soon: by the near end of the 80 % interval."""
    years = trend.years
    return years is not None and years.low is not None and years.low * YEAR_D < warn_before_d
