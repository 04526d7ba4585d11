"""`/diagnoses` and `/models` of a drive: what the store keeps for good."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Final, TypeVar

from fastapi import APIRouter, Path, Query, Request
from starlette.responses import Response

from servo_daemon.api import documents
from servo_daemon.api.answers import INVALID, UNKNOWN_DRIVE, Responses, problem_answer, tagged
from servo_daemon.api.past.queries import DriveName
from servo_daemon.api.problems import ProblemError, sentence
from servo_daemon.api.schemas import kept as schemas
from servo_daemon.published.archive import Archive, ArchiveUnavailableError, Document
from servo_daemon.published.units import iso_utc
from servo_daemon.published.view import DriveView

Found = TypeVar("Found")

_NO_STORE: Final = "no history is kept: [storage] state_dir or [history] says where it could be"
Limit = Annotated[int, Query(ge=1, le=1000, description="At most so many, the newest.")]
Number = Annotated[int, Path(ge=1, le=2**62, description="`id` of a diagnosis.")]


class KeptRoutes:
    """The handlers; the store is asked in a thread of its own.

    Args:
        find: the drive of a name, or a 404.
        prefix: of the API's paths.
    """

    def __init__(self, archive: Archive | None, find: Callable[[str], DriveView], prefix: str) -> None:
        self._archive, self._find, self._prefix = archive, find, prefix
        self._executor = ThreadPoolExecutor(1, "kept")  # its thread starts with the first request

    async def diagnoses(self, request: Request, drive: DriveName, limit: Limit = 100) -> Response:
        """The diagnoses that this drive has had, oldest first, each in short."""
        found = await self._list(drive, "diagnosis", limit)
        return self._answer(request, drive, "diagnoses", [self._short(drive, d) for d in found])

    async def models(self, request: Request, drive: DriveName, limit: Limit = 100) -> Response:
        """The models that this drive was given, oldest first."""
        found = await self._list(drive, "model", limit)
        models = [{"time": iso_utc(d.time), "effects": d.body["effects"], "before": d.body["before"]} for d in found]
        return self._answer(request, drive, "models", models)

    async def diagnosis(self, request: Request, drive: DriveName, number: Number) -> Response:
        """One diagnosis whole."""
        self._find(drive)
        archive = self._archive
        found = None
        if archive is not None:
            found = await self._ask(lambda: archive.document(drive, "diagnosis", number))
        if found is None:
            raise ProblemError(404, "unknown_diagnosis", f"There is no diagnosis {number} of drive {drive!r}.")
        document = {
            "drive": drive,
            "id": found.number,
            "time": iso_utc(found.time),
            "trigger": found.body["trigger"],
            "model": found.body["model"],
            "result": found.body["result"],
        }
        return tagged(request, documents.encode(document))

    async def _list(self, drive: str, kind: str, limit: int) -> Sequence[Document]:
        self._find(drive)
        archive = self._archive
        return () if archive is None else await self._ask(lambda: archive.documents(drive, kind, limit))

    async def _ask(self, question: Callable[[], Found]) -> Found:
        try:
            return await asyncio.get_running_loop().run_in_executor(self._executor, question)
        except ArchiveUnavailableError as error:
            raise ProblemError(503, "history_unavailable", sentence(error), {"Retry-After": "5"}) from error

    def _answer(self, request: Request, drive: str, what: str, found: list[documents.Document]) -> Response:
        reason = _NO_STORE if self._archive is None else None
        return tagged(request, documents.encode({"drive": drive, what: found, "reason": reason}))

    def _short(self, drive: str, kept: Document) -> documents.Document:
        result = kept.body["result"] or {}
        return {
            "id": kept.number,
            "time": iso_utc(kept.time),
            "trigger": kept.body["trigger"],
            "model": kept.body["model"],
            "verdict": result.get("verdict"),
            "effects": [effect["name"] for effect in result.get("effects", ())],
            "url": f"{self._prefix}/drives/{drive}/diagnoses/{kept.number}",
        }


_UNAVAILABLE: Final[Responses] = {503: problem_answer("The store of the history cannot be read now.")}


def add_routes(router: APIRouter, routes: KeptRoutes) -> None:
    """Under `/drives/{drive}`."""
    of = "/drives/{drive}"
    for path, handler, model in (
        ("/diagnoses", routes.diagnoses, schemas.DiagnosesDocument),
        ("/diagnoses/{number}", routes.diagnosis, schemas.KeptDiagnosisDocument),
        ("/models", routes.models, schemas.ModelsDocument),
    ):
        router.add_api_route(
            f"{of}{path}",
            handler,
            methods=["GET"],
            response_model=model,
            responses={**UNKNOWN_DRIVE, **INVALID, **_UNAVAILABLE},
        )
