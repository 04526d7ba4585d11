"""What is told of a parameter's ageing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Status = Literal["trend", "no_trend", "too_short"]

#: How far is looked ahead, years.
HORIZON_Y: Final = 30.0


@dataclass(frozen=True, slots=True)
class Range:
    """Median and 80 % interval; None: beyond what is looked at."""

    low: float | None
    mid: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit of `[drive.limits]`: name as there, value in the parameter's unit."""

    name: str
    value: float
    is_upper: bool


@dataclass(frozen=True, slots=True)
class Change:
    """A step.

    Attributes:
        time_d: when.
        size: in the parameter's unit.
        is_exchange: it went back towards where the value began; the trend starts anew here.
    """

    time_d: float
    size: float
    is_exchange: bool


@dataclass(frozen=True, slots=True)
class Trend:
    """What a series tells of one parameter.

    Attributes:
        status: "too_short": nothing is said yet.
        reason: in words, where there is no trend.
        probability: that there is a trend, whichever way.
        since_d: where it began: the first day, or the last exchange.
        level: now, season and temperature's effect taken out, in the parameter's unit.
        rate_1_y: its change in a year, in the parameter's unit.
        rate_percent: the same in per cent of the nominal value, else of the value at the beginning.
        limit: the one it moves to.
        years: until the limit; `high` None: longer than the horizon.
        used: share of the way from where it began (nominal value, else the beginning) to the nearest limit.
        changes: steps, oldest first.
        at_25_C: the last value at 25 °C; None: not R, or no temperature.
        remark: what should be known of the temperature's effect.
    """

    status: Status
    reason: str | None = None
    probability: float | None = None
    since_d: float | None = None
    level: Range | None = None
    rate_1_y: Range | None = None
    rate_percent: Range | None = None
    limit: Limit | None = None
    years: Range | None = None
    used: Range | None = None
    changes: tuple[Change, ...] = ()
    at_25_C: float | None = None
    remark: str | None = None
