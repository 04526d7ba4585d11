"""Errors as RFC 9457 problem details, everywhere and for everything.

`type` is "about:blank", so `title` is the HTTP status phrase, as the RFC wants it; what a program can act on is in
`code` and the further members, what a person can act on is in `detail`.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Mapping
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Match

MEDIA_TYPE: Final = "application/problem+json"

#: All but the metrics stands under it.
PREFIX: Final = "/api/v1"
#: Looking for what is like a path takes its length squared; the longest of the API with a drive's name has 100.
_LONGEST_MEANT: Final = 200
_METHODS: Final = ("GET", "POST", "PUT", "PATCH", "DELETE")
_NO_TEXT: Final = {"location": "body", "parameter": "", "detail": "not JSON in UTF-8"}
_CODES: Final = {404: "unknown_path", 405: "method_not_allowed", 422: "invalid_request"}


class ProblemError(Exception):
    """Raised by a route to answer with a problem.

    Args:
        status: HTTP status.
        code: short machine name of what is wrong.
        detail: one line for a person.
        headers: further response headers.
        members: further members of the document.
    """

    def __init__(
        self,
        status: int,
        code: str,
        detail: str,
        headers: Mapping[str, str] | None = None,
        **members: object,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.headers = headers
        self.members = members


def sentence(complaint: object) -> str:
    """What the daemon says, as a `detail`."""
    text = str(complaint)
    return f"{text[:1].upper()}{text[1:]}."


def refusal(
    path: str,
    status: int,
    code: str,
    detail: str,
    headers: Mapping[str, str] | None = None,
    **members: object,
) -> Response:
    """The document as a response to a request for `path`."""
    document = {
        "type": "about:blank",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        "instance": path,
        "code": code,
        **members,
    }
    # Half of a surrogate pair, which JSON can say of a request and UTF-8 cannot repeat, becomes "?".
    body = json.dumps(document, ensure_ascii=False, allow_nan=False).encode("utf-8", "replace")
    return Response(
        body,
        status,
        {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff", **(headers or {})},
        media_type=MEDIA_TYPE,
    )


async def _on_problem(request: Request, error: Exception) -> Response:
    assert isinstance(error, ProblemError)  # registered for this class only
    return refusal(request.url.path, error.status, error.code, error.detail, error.headers, **error.members)


async def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    path = request.url.path
    if error.status_code == 400:  # FastAPI could not make text of the body
        return refusal(path, 422, "invalid_parameter", "body: not JSON in UTF-8", errors=[_NO_TEXT])
    code, detail = _CODES.get(error.status_code, "http_error"), str(error.detail)
    if error.status_code == 404:
        meant = _meant(path, request.app.openapi()["paths"])
        detail = f"There is nothing at {path}{meant}; the API is described at /openapi.json."
    elif error.status_code == 405:
        detail = f"{path} cannot be used with {request.method}."
    headers = (
        {"Allow": ", ".join(_methods(request)).replace("GET", "GET, HEAD")}
        if error.status_code == 405
        else error.headers
    )
    return refusal(path, error.status_code, code, detail, headers)


def _meant(path: str, templates: Iterable[str]) -> str:
    """ " (did you mean /api/v1/fleet?)": the path of the API that is most like one; empty where none is.

    Args:
        templates: the API's paths, names in braces.
    """
    if len(path) > _LONGEST_MEANT:
        return ""
    words = (("" if path.startswith("/api/") else PREFIX) + path.rstrip("/")).split("/")
    known = set[str]()
    for parts in (template.split("/") for template in templates):
        if len(parts) == len(words):
            # Names stay as they were asked for.
            known.add("/".join(w if p.startswith("{") else p for p, w in zip(parts, words, strict=True)))
    like = difflib.get_close_matches("/".join(words), known, 1, cutoff=0.8)
    return f" (did you mean {like[0]}?)" if like else ""


def _methods(request: Request) -> list[str]:
    """With which this path can be used. (Starlette names those of the first route that has the path.)"""
    routes = request.app.routes
    scopes = ({**request.scope, "method": method} for method in _METHODS)
    return [s["method"] for s in scopes if any(route.matches(s)[0] == Match.FULL for route in routes)]


def _complaint(error: Mapping[str, Any]) -> dict[str, str]:
    place, *name = error["loc"]
    detail = str(error["msg"])
    if error["type"] == "json_invalid":
        detail, name = f"not JSON: {error['ctx']['error']} at character {name[0]}", []
    elif place == "body" and not name:
        detail = "a JSON object is needed, sent with Content-Type: application/json"
    return {
        "location": str(place),
        "parameter": ".".join(part for part in map(str, name) if not part.startswith("<")),  # a union's member
        "detail": detail,
    }


def _sentence(complaint: Mapping[str, str]) -> str:
    name = f" parameter '{complaint['parameter']}'" if complaint["parameter"] else ""
    return f"{complaint['location']}{name}: {complaint['detail']}"


async def _on_validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    complaints = [_complaint(e) for e in error.errors()]
    text = "; ".join(map(_sentence, complaints))
    return refusal(request.url.path, 422, "invalid_parameter", text, errors=complaints)


async def _on_anything(request: Request, _error: Exception) -> Response:
    # Starlette raises the error again after this answer, so the server's log has the traceback; the client has not.
    return refusal(request.url.path, 500, "internal_error", "The daemon failed to answer; its log says why.")


def install(app: FastAPI) -> None:
    """Every error of this application becomes a problem document."""
    app.add_exception_handler(ProblemError, _on_problem)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(RequestValidationError, _on_validation)
    app.add_exception_handler(Exception, _on_anything)


def parameter_problem(name: str, detail: str, known: Iterable[str] | None = None) -> ProblemError:
    """A query parameter that passed the types and still makes no sense; in the form of any other validation error."""
    complaint = {"location": "query", "parameter": name, "detail": detail}
    problem = ProblemError(422, "invalid_parameter", f"query parameter '{name}': {detail}", errors=[complaint])
    if known is not None:
        problem.members["known"] = list(known)
    return problem
