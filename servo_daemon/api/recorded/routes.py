"""`/captures` and `/samples` of a drive."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Final

from fastapi import APIRouter, Body, Path, Query
from starlette.responses import FileResponse, Response

from servo_daemon.api.answers import (
    INVALID,
    NO_STORE,
    REFUSED,
    UNKNOWN_DRIVE,
    Responses,
    json_response,
    problem_answer,
)
from servo_daemon.api.documents import Document, encode
from servo_daemon.api.problems import ProblemError, parameter_problem, sentence
from servo_daemon.api.recorded.scope import Edge, Trigger, column, take
from servo_daemon.api.schemas import recorded as schemas
from servo_daemon.errors import BusyError, RefusedError, ServoDaemonError
from servo_daemon.published.archive import KeptCapture
from servo_daemon.published.units import iso_utc
from servo_daemon.published.view import DaemonView, DriveView

#: A minute of samples is written in a second; a slow disk is waited for no longer than this, s.
_WAIT_S: Final = 30.0
_NONE_KEPT: Final = (
    "no captures are kept: [storage] state_dir says where they could be, [history] captures_quota_MB how many"
)
_MEDIA_TYPES: Final = {".parquet": "application/vnd.apache.parquet", ".gz": "application/gzip"}

DriveName = Annotated[str, Path(description="The drive's name in the configuration.", examples=["axis1"])]
Number = Annotated[str, Path(description="`id` of a capture.", examples=["20261121T124451103Z-60000ms-alarm"])]
Seconds = Annotated[float, Query(ge=0.001, le=5, description="How much time the snapshot shows.", examples=[0.5])]
Channel = Annotated[
    str | None, Query(max_length=64, description="The channel to trigger on; without: the last samples.")
]
Level = Annotated[float, Query(allow_inf_nan=False, description="In the unit of the channel.", examples=[1.0])]
Before = Annotated[float, Query(ge=0, le=1, description="Share of the snapshot before the trigger.")]
Since = Annotated[
    float | None, Query(allow_inf_nan=False, description="Only what comes after this device time, s: `last_s` before.")
]


class RecordedRoutes:
    """The handlers.

    Args:
        find: the drive of a name, or a 404.
        prefix: of the API's paths.
    """

    def __init__(self, daemon: DaemonView, find: Callable[[str], DriveView], prefix: str) -> None:
        self._kept, self._find, self._prefix = daemon.captures, find, prefix
        self._executor = ThreadPoolExecutor(1, "samples")  # its thread starts with the first request

    async def captures(self, drive: DriveName) -> Response:
        """The recordings that are kept of this drive: of the minute around its events and of its diagnoses."""
        self._find(drive)
        kept = () if self._kept is None else self._kept.of(drive)
        reason = _NONE_KEPT if self._kept is None else None
        return json_response({"drive": drive, "captures": [self._document(k) for k in kept], "reason": reason})

    async def record(
        self, drive: DriveName, wanted: Annotated[schemas.CaptureRequestDocument | None, Body()] = None
    ) -> Response:
        """Keep the last samples of this drive. Answers when the file is there."""
        self._find(drive)
        if self._kept is None:
            raise ProblemError(409, "not_allowed", sentence(_NONE_KEPT))
        seconds = (wanted or schemas.CaptureRequestDocument()).seconds
        try:
            future = asyncio.wrap_future(self._kept.request(drive, seconds))
            kept = await asyncio.wait_for(future, _WAIT_S)
        except BusyError as error:
            raise ProblemError(409, "not_now", sentence(error), {"Retry-After": "5"}) from error
        except RefusedError as error:
            raise ProblemError(409, "not_allowed", sentence(error)) from error
        except ServoDaemonError as error:
            raise ProblemError(503, "not_written", sentence(error), {"Retry-After": "5"}) from error
        except TimeoutError as error:
            raise ProblemError(503, "not_written", "The disk takes too long.", {"Retry-After": "30"}) from error
        return json_response(self._document(kept), 201)

    async def capture(self, drive: DriveName, capture: Number) -> Response:
        """One recording as a file: Parquet where the daemon has pyarrow, else CSV in gzip."""
        self._find(drive)
        kept = next((k for k in (self._kept.of(drive) if self._kept else ()) if k.id == capture), None)
        if kept is None or not await asyncio.get_running_loop().run_in_executor(self._executor, kept.path.is_file):
            raise ProblemError(
                404, "unknown_capture", f"There is no capture {capture!r} of drive {drive!r} (any more)."
            )
        media_type = _MEDIA_TYPES[kept.path.suffix]
        return FileResponse(kept.path, filename=_file_name(kept), media_type=media_type, headers=NO_STORE)

    def _document(self, kept: KeptCapture) -> Document:
        return {
            "id": kept.id,
            "kind": kept.kind,
            "start": iso_utc(kept.start),
            "end": iso_utc(kept.end),
            "bytes": kept.size,
            "file": _file_name(kept),
            "url": f"{self._prefix}/drives/{kept.drive}/captures/{kept.id}",
        }

    async def samples(
        self,
        drive: DriveName,
        seconds: Seconds = 1.0,
        trigger: Channel = None,
        level: Level = 0.0,
        edge: Edge = "rising",
        before: Before = 0.2,
        since: Since = None,
    ) -> Response:
        """The last samples, as an oscilloscope takes them: up to now, or about the last time that a channel crossed a
        level (looked for in the last ten seconds). None are there where `[drive.estimation] ring_s` is 0."""
        view = self._find(drive)
        wanted = None if trigger is None else Trigger(trigger, level, edge, before)
        body = await asyncio.get_running_loop().run_in_executor(
            self._executor, lambda: _samples(view, seconds, wanted, since)
        )
        return Response(body, headers=NO_STORE, media_type="application/json")


def _file_name(kept: KeptCapture) -> str:
    return f"{kept.drive}-{kept.path.name}"


def _samples(view: DriveView, seconds: float, trigger: Trigger | None, since: float | None) -> bytes:
    when, blocks = view.snapshot().time, view.samples()
    try:
        found = take(blocks, seconds, trigger, since)
    except KeyError as error:
        channels = list(blocks[-1].channels)
        detail = f"there is no channel {error.args[0]!r}; the channels are {', '.join(channels)}"
        raise parameter_problem("trigger", detail, channels) from error
    block = found.block
    asked = trigger and {"channel": trigger.channel, "level": trigger.level, "edge": trigger.edge}
    return encode(
        {
            "drive": view.name,
            "time": None if when is None else iso_utc(when),
            "last_s": found.last_s,
            "trigger": asked and {**asked, "time_s": found.trigger_s},
            "shortened": found.shortened,
            "time_s": [] if block is None else block.time_s.round(7).tolist(),
            "signals": {} if block is None else {name: column(getattr(block, name)) for name in block.channels},
        }
    )


_NOT_KEPT: Final[Responses] = {
    409: problem_answer("None are kept (`code` `not_allowed`), or there is nothing to keep yet (`not_now`)."),
    503: problem_answer("It could not be written; `detail` says why."),
}
_FILE: Final[Responses] = {
    200: {"description": "The file.", "content": {media_type: {} for media_type in _MEDIA_TYPES.values()}},
    404: problem_answer("There is no such drive, or no such capture (any more)."),
}


def add_routes(router: APIRouter, routes: RecordedRoutes) -> None:
    """Under `/drives/{drive}`."""
    of = "/drives/{drive}"
    router.add_api_route(
        f"{of}/captures",
        routes.captures,
        methods=["GET"],
        response_model=schemas.CapturesDocument,
        responses=UNKNOWN_DRIVE,
    )
    router.add_api_route(
        f"{of}/captures",
        routes.record,
        methods=["POST"],
        status_code=201,
        response_model=schemas.CaptureDocument,
        responses={**UNKNOWN_DRIVE, **INVALID, **_NOT_KEPT, **REFUSED},
    )
    router.add_api_route(
        f"{of}/captures/{{capture}}", routes.capture, methods=["GET"], response_class=Response, responses=_FILE
    )
    router.add_api_route(
        f"{of}/samples",
        routes.samples,
        methods=["GET"],
        response_model=schemas.SamplesDocument,
        responses={**UNKNOWN_DRIVE, **INVALID},
    )
