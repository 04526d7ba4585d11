"""`/history` and `/events`: the past, from the store where there is one, else from memory."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

from fastapi import APIRouter, Request
from starlette.responses import Response

from servo_daemon.api.answers import INVALID, UNKNOWN_DRIVE, Responses, problem_answer, tagged
from servo_daemon.api.past import documents, spans
from servo_daemon.api.past.queries import (
    DEFAULT_POINTS,
    MOST_EVENTS,
    Before,
    DriveName,
    Kinds,
    LevelName,
    Limit,
    Points,
    Question,
    SeriesNames,
    TimeText,
    Window,
    question,
    split_names,
    time_of,
)
from servo_daemon.api.problems import ProblemError, parameter_problem
from servo_daemon.api.schemas import past as schemas
from servo_daemon.published.archive import Archive, ArchiveUnavailableError, EventPage, Span
from servo_daemon.published.history import HistorySeries
from servo_daemon.published.memory import memory_span
from servo_daemon.published.rollup import fewer
from servo_daemon.published.units import split_unit
from servo_daemon.published.view import DaemonView, DriveView

Found = TypeVar("Found")

#: What every drive shows beside its parameters, as far as it is measured or follows from it.
_STATE: Final = ("current_A", "velocity_rad_s", "position_rad")


class PastRoutes:
    """The handlers. What may wait for a disk runs in threads of its own.

    Args:
        find: the drive of a name, or a 404.
    """

    def __init__(self, daemon: DaemonView, find: Callable[[str], DriveView]) -> None:
        self._archive, self._find = daemon.archive, find
        self._executor = ThreadPoolExecutor(2, "history")  # its threads start with the first request

    async def history(
        self,
        request: Request,
        drive: DriveName,
        parameter: SeriesNames,
        start: TimeText = None,
        end: TimeText = None,
        window: Window = None,
        points: Points = DEFAULT_POINTS,
        level: LevelName = None,
    ) -> Response:
        """Parameters or state channels over time: the last half hour unless told otherwise, years where they are kept.

        As `Accept` asks: JSON, `text/csv`, or Parquet (`application/vnd.apache.parquet`).
        """
        view = self._find(drive)
        kind = spans.wanted(request.headers.get("accept", ""))
        asked = question(parameter, start, end, window, points, level)
        if kind == "json" and len(asked.names) == 1 and (self._archive is None or self._in_memory(view, asked)):
            return tagged(request, documents.encode_series(view, _from_memory(view, asked)))
        if kind != "json":
            spans.check_available(kind)
        return await self._call(self._answer, request, view, asked, kind)

    def _in_memory(self, view: DriveView, asked: Question) -> bool:
        """Whether the ring alone holds all of the span."""
        ring = view.history
        if asked.level not in {None, "rows"}:
            return False
        return len(ring) == ring.capacity if asked.start is None else ring.holds(asked.start)

    def _answer(self, request: Request, view: DriveView, asked: Question, kind: spans.Kind) -> Response:
        span, note = self._span(view, asked, must=kind != "json")
        _check_known(view, self._archive, asked.names, span)
        if kind != "json":
            body, media_type = spans.encode(span, asked.names, _units(view), kind)
            return tagged(request, body, media_type)
        if len(asked.names) > 1:
            return tagged(request, documents.encode_span(view, asked.names, span, note))
        series = documents.series_of(span, asked.names[0], _empty(view, asked.names[0]), asked.points)
        return tagged(request, documents.encode_series(view, series, span, note))

    def _span(self, view: DriveView, asked: Question, *, must: bool) -> tuple[Span, str | None]:
        """From the store, or what memory has with a note why.

        Raises:
            ProblemError: 503, the store cannot be read and `must` be, because nobody would see the note.
        """
        names = (*asked.names, *(f"{name}_true" for name in asked.names)) if len(asked.names) == 1 else asked.names
        end = math.inf if asked.end is None else asked.end
        start = -math.inf if asked.start is None else asked.start
        note = None
        if self._archive is not None:
            begin = _default_start(view) if asked.start is None else asked.start
            single = len(asked.names) == 1 and not must
            try:
                span = self._archive.span(view.name, names, begin, asked.end, asked.points, asked.level)
                return (span if single else _limited(span, asked.points)), None
            except ValueError as error:
                raise parameter_problem("level", str(error)) from error
            except ArchiveUnavailableError as error:
                note = str(error)
                if must:
                    raise ProblemError(503, "history_unavailable", note, {"Retry-After": "5"}) from error
        last = view.snapshot().time
        span = memory_span(view.history, names, start, end if last is None else min(end, last))
        return (span if len(asked.names) == 1 and not must else _limited(span, asked.points)), note

    async def events(
        self,
        request: Request,
        drive: DriveName,
        kinds: Kinds = None,
        since: TimeText = None,
        limit: Limit = MOST_EVENTS,
        before: Before = None,
    ) -> Response:
        """What happened to this drive, oldest first: the newest of all that match, and by `next` those before them."""
        view = self._find(drive)
        wanted = split_names("kinds", kinds) if kinds else ()
        since_s = time_of("since", since, time.time())
        if self._archive is None:
            return tagged(request, documents.encode_events(_memory_events(view, wanted, since_s, limit)))
        return await self._call(self._page, request, view, wanted, since_s, limit, before)

    def _page(
        self, request: Request, view: DriveView, kinds: Sequence[str], since_s: float | None, limit: int,
        before: int | None,
    ) -> Response:  # fmt: skip
        assert self._archive is not None
        try:
            page = self._archive.events(view.name, kinds, since_s, limit, before)
        except ArchiveUnavailableError:
            page = _memory_events(view, kinds, since_s, limit)
        return tagged(request, documents.encode_events(page))

    async def _call(self, work: Callable[..., Found], *arguments: object) -> Found:
        return await asyncio.get_running_loop().run_in_executor(self._executor, lambda: work(*arguments))


def _default_start(view: DriveView) -> float:
    """As far back as the ring would reach, were it full."""
    last = view.snapshot().time
    return (time.time() if last is None else last) - view.history.capacity / view.history.rate_hz


def _limited(span: Span, points: int) -> Span:
    return Span(span.level, span.start_s, span.end_s, fewer(span.buckets, points))


def _from_memory(view: DriveView, asked: Question) -> HistorySeries:
    """One series of the ring. Rows later than the last one are of a clock that has been set back since."""
    name, last = asked.names[0], view.snapshot().time
    end = asked.end if last is None else last if asked.end is None else min(last, asked.end)
    if asked.level not in {None, "rows"}:
        raise parameter_problem("level", "only 'rows' are kept: there is no [history]")
    try:
        return view.history.query(name, asked.start, end, asked.points)
    except KeyError:
        _check_known(view, None, asked.names, None)
        return _empty(view, name)


def _units(view: DriveView) -> Mapping[str, str]:
    return {p.name: p.unit for p in view.initial_parameters}


def _empty(view: DriveView, name: str) -> HistorySeries:
    units = _units(view)
    return HistorySeries.empty(name, units.get(name, split_unit(name)[1]), parameter=name in units)


def _check_known(view: DriveView, archive: Archive | None, names: Sequence[str], span: Span | None) -> None:
    """Raises: ProblemError: 422, one is no series of this drive, and none is kept of an earlier model."""
    found = () if span is None else span.buckets.names
    known = dict.fromkeys([*_units(view), *view.history.names(), *_STATE, *found])
    if all(name in known for name in names):
        return
    if archive is not None:
        try:
            known |= dict.fromkeys(archive.names(view.name))
        except ArchiveUnavailableError:
            return  # it may well be known
    for name in names:
        if name not in known:
            listed = [k for k in known if not k.endswith("_true")]
            raise parameter_problem("parameter", f"{name!r} has no history; known are {', '.join(listed)}", listed)


def _memory_events(view: DriveView, kinds: Sequence[str], since_s: float | None, limit: int) -> EventPage:
    found = [
        e for e in view.events() if (not kinds or e.kind in kinds) and (since_s is None or e.time >= since_s)
    ]  # fmt: skip
    return EventPage(tuple(found[-limit:]), None)


_UNAVAILABLE: Final[Responses] = {
    406: problem_answer("Parquet needs a package that is not installed; `detail` says which."),
    503: problem_answer("The store of the history cannot be read now."),
}
_TABLES: Final[Responses] = {
    200: {
        "description": "JSON, or a table as `Accept` asks.",
        "content": {
            spans.CSV: {"example": "time,R,R_std,R_status\n2026-11-21T12:45:21.103Z,0.6391,0.0012,tracking\n"},
            spans.PARQUET: {},
        },
    }
}


def add_routes(router: APIRouter, routes: PastRoutes) -> None:
    """`/drives/{drive}/history` and `/events`."""
    router.add_api_route(
        "/drives/{drive}/history",
        routes.history,
        methods=["GET"],
        response_model=schemas.HistoryDocument | schemas.HistoriesDocument,
        responses={**UNKNOWN_DRIVE, **INVALID, **_UNAVAILABLE, **_TABLES},
    )
    router.add_api_route(
        "/drives/{drive}/events",
        routes.events,
        methods=["GET"],
        response_model=schemas.EventsDocument,
        responses={**UNKNOWN_DRIVE, **INVALID},
    )
