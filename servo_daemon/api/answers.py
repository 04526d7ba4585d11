"""What the routes' answers have in common, and how OpenAPI is told of the problems among them."""

from __future__ import annotations

import hashlib
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import Response

from servo_daemon.api import documents
from servo_daemon.api.problems import MEDIA_TYPE

Responses = dict[int | str, dict[str, Any]]

NO_STORE: Final = {"Cache-Control": "no-store"}
_PROBLEM_REF: Final = "#/components/schemas/ProblemDocument"


def json_response(document: documents.Document, status: int = 200) -> Response:
    """A document as an answer."""
    return Response(documents.encode(document), status, NO_STORE, media_type="application/json")


def tagged(request: Request, body: bytes, media_type: str = "application/json") -> Response:
    """An answer with an entity tag: 304 and nothing more where the client has it already (RFC 9110, 13.1.2)."""
    etag = f'"{hashlib.blake2b(body, digest_size=12).hexdigest()}"'
    headers = {"ETag": etag, "Cache-Control": "no-cache", "Vary": "Accept"}
    known = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    if etag in known or "*" in known:
        return Response(status_code=304, headers=headers)
    return Response(body, headers=headers, media_type=media_type)


def problem_answer(description: str) -> dict[str, Any]:
    """A problem document among a route's answers."""
    return {"description": description, "content": {MEDIA_TYPE: {"schema": {"$ref": _PROBLEM_REF}}}}


UNKNOWN_DRIVE: Final[Responses] = {404: problem_answer("There is no such drive; `known` names those there are.")}
INVALID: Final[Responses] = {422: problem_answer("A parameter is missing or makes no sense; `errors` names it.")}
REFUSED: Final[Responses] = {403: problem_answer("Asked for by a page of another site.")}
