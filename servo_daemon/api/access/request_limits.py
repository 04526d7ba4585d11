"""How much one request may say. What is larger is refused before it is read; what is slow, while it is.

No route takes more than a small JSON object, and the event loop shares the interpreter with the pipelines: a body of
60 MB took 22 s and 1.7 GB in which no sample was worked off. A body is read here, whole, and handed on; so the routes
and their parsers only ever see one that is within the limits.
"""

from __future__ import annotations

import asyncio
import re
from typing import Final

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from servo_daemon.api.problems import refusal

#: Bytes of a body. The largest that a route has use for is a model with a start value for every parameter: 5 kB.
MAX_BODY: Final = 64 * 1024
#: Bytes of path and query, and of all header lines: what nginx takes by default (`large_client_header_buffers 4 8k`).
MAX_URL: Final = 8 * 1024
MAX_HEADERS: Final = 32 * 1024
#: Levels of arrays and objects in a body; the routes' own have three.
MAX_DEPTH: Final = 32
#: A body must be complete within this time, s: 64 kB over a line of 5 kB/s.
BODY_S: Final = 15.0

#: A string to its end (or that of the text), which cannot be tried twice; or a bracket.
_TOKEN: Final = re.compile(rb'"(?:[^"\\]|\\.)*"?|[\[\]{}]', re.DOTALL)

_Refusal = tuple[int, str, str]


def too_deep(body: bytes) -> bool:
    """Whether arrays and objects of this JSON text stand too deep in each other. Linear in its length."""
    depth = 0
    for match in _TOKEN.finditer(body):
        first = match[0][:1]
        depth += (first in b"[{") - (first in b"]}")
        if depth > MAX_DEPTH:
            return True
    return False


class RequestLimits:
    """ASGI middleware: refuses requests that are too large before a route sees them."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        refused = _head_refusal(scope, headers)
        if refused is None and (headers.get("content-length", "0") != "0" or "transfer-encoding" in headers):
            body = await _read(receive)
            if body is None:
                return  # the client has gone
            if isinstance(body, bytes):
                receive = _replay(body, receive)
            else:
                refused = body
        if refused is None:
            await self.app(scope, receive, send)
        else:
            # What is left of the request is not read: the connection ends with the answer.
            await refusal(scope["path"], *refused, {"Connection": "close"})(scope, receive, send)


def _head_refusal(scope: Scope, headers: Headers) -> _Refusal | None:
    if len(scope.get("raw_path") or b"") + len(scope["query_string"]) > MAX_URL:
        return 414, "url_too_long", f"The address is longer than {MAX_URL} bytes."
    if sum(len(name) + len(value) + 4 for name, value in headers.raw) > MAX_HEADERS:
        return 431, "headers_too_large", f"The request's headers are longer than {MAX_HEADERS} bytes."
    length = headers.get("content-length", "0")
    return _TOO_LARGE if not length.isdecimal() or int(length[:20]) > MAX_BODY else None


_TOO_LARGE: Final[_Refusal] = (413, "body_too_large", f"The request's body is longer than {MAX_BODY} bytes.")


async def _read(receive: Receive) -> bytes | _Refusal | None:
    """The body; why it is refused; None: the client has gone."""
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            while True:
                message = await receive()
                if message["type"] != "http.request":
                    return None
                body += message.get("body", b"")
                if len(body) > MAX_BODY:
                    return _TOO_LARGE
                if not message.get("more_body", False):
                    break
    except TimeoutError:
        return 408, "too_slow", f"The request's body was not complete within {BODY_S:g} s."
    whole = bytes(body)
    if too_deep(whole):
        return 422, "invalid_parameter", f"body: not JSON nested at most {MAX_DEPTH} deep"
    return whole


def _replay(body: bytes, receive: Receive) -> Receive:
    """`receive` as it would have been without us: the body first, then what else comes (that the client goes)."""
    first: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replayed() -> Message:
        return first.pop() if first else await receive()

    return replayed
