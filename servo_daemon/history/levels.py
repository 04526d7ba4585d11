"""How finely the past is kept, by age."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from servo_daemon.config import HistoryConfig


@dataclass(frozen=True, slots=True)
class Level:
    """One resolution.

    Attributes:
        number: 0 is the finest.
        name: as answers call it.
        period_s: length of a bucket; 0: single rows.
        block_s: rows of so long a span become one packed block, and are then rolled up into the next level. A divisor
            of the next level's.
        keep_s: how long they are kept.
        whole: what is added to an open block is joined with what is there: one to be read instead of many, where
            little is added seldom.
    """

    number: int
    name: str
    period_s: float
    block_s: float
    keep_s: float
    whole: bool


#: Rows a second that the ring delivers at most (`published/history.py`).
ROW_S: Final = 0.1
_HOUR, _DAY, _YEAR = 3600.0, 86_400.0, 365.25 * 86_400.0


def levels_of(config: HistoryConfig) -> tuple[Level, ...]:
    """The levels, finest first. Blocks have 240 to 600 rows: long enough to be compressed well (one of 60 takes half as
    much again), short enough that a year is read in a few milliseconds."""
    return (
        Level(0, "rows", 0.0, 60.0, config.rows_hours * _HOUR, False),
        Level(1, "1 s", 1.0, 600.0, config.seconds_days * _DAY, False),
        Level(2, "1 min", 60.0, 6 * _HOUR, config.minutes_days * _DAY, True),
        Level(3, "1 h", 3600.0, 20 * _DAY, config.hours_years * _YEAR, True),
    )


def choose(levels: tuple[Level, ...], start_s: float, end_s: float, points: int, now_s: float) -> Level:
    """The best level for a question: still kept at its start, and the coarsest with at least two buckets a point."""
    kept = [level for level in levels if start_s >= now_s - level.keep_s] or [levels[-1]]
    enough = [k for k in kept if (end_s - start_s) / max(k.period_s, ROW_S) >= 2 * points]
    return enough[-1] if enough else kept[0]
