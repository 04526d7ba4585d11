"""What may be asked of the past: the query parameters, and the question that they make."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Final

from fastapi import Path, Query

from servo_daemon.api.problems import parameter_problem
from servo_daemon.api.times import ACCEPTED, DURATIONS, parse_duration, parse_time

#: Points of a series where nobody asks for another number, about a screen's width; and the most.
DEFAULT_POINTS: Final = 1000
MAX_POINTS: Final = 20_000
#: As many series as the page could show, and more than a drive has.
MOST_SERIES: Final = 64
#: As many events as the memory holds.
MOST_EVENTS: Final = 1000

DriveName = Annotated[str, Path(description="The drive's name in the configuration.", examples=["axis1"])]
TimeText = Annotated[str | None, Query(description=f"Inclusive; {ACCEPTED}.", examples=["-10min"])]
Window = Annotated[
    str | None,
    Query(description=f"Instead of `start`: how far back from the end; {DURATIONS}.", examples=["1y"]),
]
Points = Annotated[
    int,
    Query(
        ge=2,
        le=MAX_POINTS,
        description="At most so many rows. More single rows are thinned: of equally many each the lowest and the "
        "highest value are kept, as they were recorded. Buckets are summed up, with `min` and `max` of all.",
    ),
]
SeriesNames = Annotated[
    str,
    Query(
        max_length=2000,
        description="A parameter (`R`, `L`, `K`, `J`, `B`, an effect's own) or a state channel (`current_A`, "
        "`velocity_rad_s`, ...); several, separated by commas, get one column of times.",
        examples=["R", "R,K,current_A"],
    ),
]
LevelName = Annotated[
    str | None,
    Query(description="`rows`, `1 s`, `1 min` or `1 h` instead of the level that suits.", examples=["1 min"]),
]
Kinds = Annotated[
    str | None, Query(max_length=2000, description="Only these, separated by commas.", examples=["alarm"])
]
Limit = Annotated[int, Query(ge=1, le=MOST_EVENTS, description="At most so many, the newest.")]
Before = Annotated[int | None, Query(ge=1, le=2**62, description="`next` of the page after this one.")]


@dataclass(frozen=True, slots=True)
class Question:
    names: tuple[str, ...]
    start: float | None
    end: float | None
    points: int
    level: str | None


def question(
    parameter: str, start: str | None, end: str | None, window: str | None, points: int, level: str | None
) -> Question:
    now = time.time()
    names = split_names("parameter", parameter)
    start_s, end_s = time_of("start", start, now), time_of("end", end, now)
    if window is not None:
        if start is not None:
            raise parameter_problem("window", "give start or window, not both")
        try:
            start_s = (now if end_s is None else end_s) - parse_duration(window)
        except ValueError as error:
            raise parameter_problem("window", str(error)) from error
    if start_s is not None and end_s is not None and start_s > end_s:
        raise parameter_problem("start", "must not be after 'end'")
    return Question(names, start_s, end_s, points, level)


def split_names(name: str, text: str) -> tuple[str, ...]:
    parts = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    if "" in parts:
        raise parameter_problem(name, "a name is missing")
    if len(parts) > MOST_SERIES:
        raise parameter_problem(name, f"at most {MOST_SERIES} names")
    return parts


def time_of(name: str, text: str | None, now_s: float) -> float | None:
    if text is None:
        return None
    try:
        return parse_time(text, now_s)
    except ValueError as error:
        raise parameter_problem(name, str(error)) from error
