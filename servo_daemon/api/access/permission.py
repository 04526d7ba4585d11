"""ASGI middleware: asks for a token where there are any, and writes down who has changed something."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from typing import Final

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from servo_daemon.api.access import tokens
from servo_daemon.api.access.tokens import TokenFile
from servo_daemon.api.problems import refusal

audit = logging.getLogger("servo_daemon.audit")

_SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
_MODEL: Final = re.compile(r"/drives/[^/]+/model/?")
_CHALLENGE: Final = {"WWW-Authenticate": 'Basic realm="servo-daemon", charset="UTF-8"'}


def scope_of(method: str, path: str) -> tokens.Scope:
    """The scope that a token needs for this request."""
    if method in _SAFE:
        return "read"
    return "configure" if _MODEL.search(path) else "operate"


@dataclass(slots=True)
class Access:
    """Who may ask for what. The program may exchange each while it runs.

    Attributes:
        tokens: None: whoever reaches the daemon may do everything.
        open_metrics: `/metrics` needs no token.
        hosts: DNS names by which browsers may reach the daemon, beyond IP addresses, local names and this machine's
            own; see `guard.py`.
    """

    tokens: TokenFile | None = None
    open_metrics: bool = False
    hosts: tuple[str, ...] = ()


class Permission:
    """Lets a request through if its token permits it, and logs changes."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        method, path = scope["method"], scope["path"]
        who = "anybody"
        known = self._access.tokens
        if known is not None and not (self._access.open_metrics and path == "/metrics" and method in _SAFE):
            token = known.find(Headers(scope=scope).get("authorization", ""))
            needed = scope_of(method, path)
            if token is None:
                answer = refusal(path, 401, "no_token", "A token is needed: Authorization: Bearer …", _CHALLENGE)
                await answer(scope, receive, self._told(scope, "nobody known", send))
                return
            who = token.name
            if not token.allows(needed):
                detail = f"The token {who} allows {token.scope}; this needs {needed}."
                await refusal(path, 403, "not_allowed", detail)(scope, receive, self._told(scope, who, send))
                return
        await self.app(scope, receive, self._told(scope, who, send))

    def _told(self, scope: Scope, who: str, send: Send) -> Send:
        """`send` that also writes an attempt to change something into the log."""
        if scope["method"] in _SAFE:
            return send
        client = (scope.get("client") or ("this machine",))[0]

        async def audited(message: Message) -> None:
            if message["type"] == "http.response.start":
                text = "%s from %s: %s %s: %d"
                audit.info(text, who, client, scope["method"], ascii(scope["path"])[1:-1], message["status"])
            await send(message)

        return audited
