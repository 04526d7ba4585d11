"""Between httpx and the clients: an answer's content, or the error that it tells."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any, Final

import httpx

from servo_daemon.client.errors import DaemonError, UnreachableError
from servo_daemon.client.records import Estimates
from servo_daemon.client.steps import Ask

_PREFIX: Final = "/api/v1"
_DATA: Final = "data: "


def check(answer: httpx.Response) -> None:
    """Raises: DaemonError: the answer, which has been read, is a problem."""
    if answer.is_success:
        return
    try:
        problem = answer.json()
    except ValueError:
        problem = {}
    raise DaemonError(answer.status_code, problem if isinstance(problem, dict) else {})


def content(ask: Ask, answer: httpx.Response) -> Any:
    """What was asked for: a JSON document, or bytes.

    Raises:
        DaemonError: the answer is a problem.
    """
    check(answer)
    return answer.content if ask.is_file else answer.json()


def address(path: str) -> str:
    """Of a path below the API's prefix."""
    return _PREFIX + path


def options(ask: Ask) -> dict[str, Any]:
    """A request's parameters and body for httpx."""
    return {"params": dict(ask.params), **({} if ask.body is None else {"json": ask.body})}


def headers(token: str | None) -> dict[str, str]:
    """Those of every request."""
    return {} if token is None else {"Authorization": f"Bearer {token}"}


def unreachable(url: object, error: httpx.TransportError) -> UnreachableError:
    """The error of a daemon that does not answer."""
    return UnreachableError(f"no daemon answers at {url}: {error or type(error).__name__}")


def estimates_in(line: str) -> Iterable[Estimates]:
    """What a line of the stream of estimates holds: one document, or none."""
    return (Estimates.of(json.loads(line.removeprefix(_DATA))),) if line.startswith(_DATA) else ()
