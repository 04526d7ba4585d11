"""The routes of what a drive's model lacks: its diagnosis, the report, and another model.

Nothing is done here: a diagnosis runs in a process of its own, a model is exchanged by the pipeline. `POST /model`
waits for the first estimate of the new model, which takes a second, or some where its plant has to be compiled first.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import APIRouter
from fastapi import Path as PathParameter
from starlette.responses import Response

from servo_daemon.api.answers import INVALID, NO_STORE, REFUSED, UNKNOWN_DRIVE, Responses, json_response, problem_answer
from servo_daemon.api.documents import Document
from servo_daemon.api.problems import ProblemError, sentence
from servo_daemon.api.schemas import diagnosis as schemas
from servo_daemon.errors import BusyError, ModelError, RefusedError, ServoDaemonError
from servo_daemon.published.units import iso_utc
from servo_daemon.published.view import DriveView, ModelChange, StartValues

#: How long an answer waits for the first estimate; a drive that does not speak is waited for no longer than that, s.
WAIT_S: Final = 30.0
_SILENT_S: Final = 1.0
_LOOK_EVERY_S: Final = 0.05

DriveName = Annotated[str, PathParameter(description="The drive's name in the configuration.", examples=["axis1"])]


def diagnosis_document(drive: DriveView, prefix: str) -> Document:
    """`GET /drives/{d}/diagnosis`.

    Args:
        prefix: of the API's paths.
    """
    view = drive.diagnosis
    d = view.diagnosis
    adoption = view.adoption
    return {
        "drive": drive.name,
        "status": d.status,
        "trigger": d.trigger,
        "model": None if d.model is None else list(d.model),
        "started": None if d.started is None else iso_utc(d.started),
        "finished": None if d.finished is None else iso_utc(d.finished),
        "samples": d.samples,
        "span_s": round(d.span_s, 6),
        "progress": d.progress,
        "step": d.step,
        "reason": d.reason,
        "result": d.result,
        "report": None if d.report is None else f"{prefix}/drives/{drive.name}/diagnosis/report",
        "adoption": {
            "allowed": adoption.allowed,
            "reason": adoption.reason,
            "effects": None if adoption.effects is None else list(adoption.effects),
        },
        "request": {"allowed": view.allowed, "reason": view.reason},
    }


@contextmanager
def _as_problems() -> Iterator[None]:
    """What the daemon refuses, as the API says it."""
    try:
        yield
    except ModelError as error:
        complaint = {"location": "body", "parameter": error.where, "detail": str(error)}
        members: dict[str, Any] = {"errors": [complaint]}
        if error.known:
            members["known"] = list(error.known)
        detail = f"body parameter '{error.where}': {error}"
        raise ProblemError(422, "invalid_parameter", detail, **members) from error
    except BusyError as error:
        raise ProblemError(409, "not_now", sentence(error), {"Retry-After": "5"}) from error
    except RefusedError as error:
        raise ProblemError(409, "not_allowed", sentence(error)) from error
    except ServoDaemonError as error:
        raise ProblemError(409, "not_done", sentence(error)) from error


def _start(parameters: dict[str, float | str | schemas.StartValueDocument]) -> StartValues:
    return {
        name: (p.value, p.std or None) if isinstance(p, schemas.StartValueDocument) else (p, None)
        for name, p in parameters.items()
    }


class DiagnosisRoutes:
    """The handlers.

    Args:
        drive: looks a drive up by its name; raises ProblemError.
        prefix: of the API's paths.
        stopping: whether the daemon has been told to stop.
    """

    def __init__(self, drive: Callable[[str], DriveView], prefix: str, stopping: Callable[[], bool]) -> None:
        self._drive, self._prefix, self._stopping = drive, prefix, stopping

    async def diagnosis(self, drive: DriveName) -> Response:
        """The last diagnosis: how far it is, or what it says."""
        return json_response(diagnosis_document(self._drive(drive), self._prefix))

    async def begin(self, drive: DriveName) -> Response:
        """Diagnose the last samples (`[drive.estimation] ring_s`) in a process of its own. Answers at once."""
        view = self._drive(drive)
        with _as_problems():
            view.request_diagnosis()
        return json_response(diagnosis_document(view, self._prefix), 202)

    async def report(self, drive: DriveName) -> Response:
        """The last diagnosis as a page."""
        report = self._drive(drive).diagnosis.diagnosis.report
        answer = None if report is None else await asyncio.get_running_loop().run_in_executor(None, _read, report)
        if answer is None:
            raise ProblemError(404, "no_report", f"There is no report of drive {drive!r}.")
        body, policy = answer
        headers = {**NO_STORE, "Content-Security-Policy": policy}
        return Response(body, headers=headers, media_type="text/html; charset=utf-8")

    async def model(self, drive: DriveName, wanted: schemas.ModelRequestDocument) -> Response:
        """Go over to another model while the drive runs. Parameters that both models have keep what is known of them.

        Answers when the first estimate of the new model is published (a second, some more where its plant must be
        compiled first), or with 202 where no samples come.
        """
        view = self._drive(drive)
        with _as_problems():
            future = view.request_model(wanted.effects, _start(wanted.parameters))
            change = await self._done(view, future)
        if change is None:
            return json_response({"drive": drive, "model": wanted.effects, "time": None, "done": False}, 202)
        when = None if change.time is None else iso_utc(change.time)
        return json_response({"drive": drive, "model": list(change.model), "time": when, "done": True})

    async def _done(self, view: DriveView, future: Future[ModelChange]) -> ModelChange | None:
        """The change; None where it will take longer.

        Raises:
            ServoDaemonError: it came to nothing.
        """
        began = time.monotonic()
        while not future.done():
            waited = time.monotonic() - began
            speaks = view.snapshot().connection == "connected"
            if self._stopping() or waited > WAIT_S or (waited > _SILENT_S and not speaks):
                return None
            await asyncio.sleep(_LOOK_EVERY_S)
        return future.result()


def _read(path: Path) -> tuple[bytes, str] | None:
    """The report and the policy that admits its script; None if it has gone. In a thread."""
    from servo_daemon.report import content_security_policy

    try:
        return path.read_bytes(), content_security_policy()
    except OSError:
        return None


_NOT_NOW: Final[Responses] = {
    409: problem_answer(
        "Not now (one is under way, too few samples; `code` `not_now`), or the configuration forbids it."
    )
}
_NO_REPORT: Final[Responses] = {
    200: {
        "description": "The report, one self-contained file.",
        "content": {"text/html": {"example": "<!doctype html>"}},
    },
    404: problem_answer("There is no such drive, or no report of it yet (`code` `no_report`)."),
}


def add_routes(router: APIRouter, routes: DiagnosisRoutes) -> None:
    """Under `/drives/{drive}`."""
    of = "/drives/{drive}"
    document = schemas.DiagnosisDocument
    router.add_api_route(
        f"{of}/diagnosis", routes.diagnosis, methods=["GET"], response_model=document, responses=UNKNOWN_DRIVE
    )
    router.add_api_route(
        f"{of}/diagnosis",
        routes.begin,
        methods=["POST"],
        status_code=202,
        response_model=document,
        responses={**UNKNOWN_DRIVE, **_NOT_NOW, **REFUSED},
    )
    router.add_api_route(
        f"{of}/diagnosis/report", routes.report, methods=["GET"], response_class=Response, responses=_NO_REPORT
    )
    waiting: Responses = {202: {"model": schemas.ModelDocument, "description": "It waits for samples."}}
    router.add_api_route(
        f"{of}/model",
        routes.model,
        methods=["POST"],
        response_model=schemas.ModelDocument,
        responses={**waiting, **UNKNOWN_DRIVE, **_NOT_NOW, **INVALID, **REFUSED},
    )
