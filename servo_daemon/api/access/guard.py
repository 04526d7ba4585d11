"""Who may talk to the API from a browser: pages of this daemon, and nobody else.

The API has no passwords; it is meant for a trusted network. What it must not be is a tool of any web page that a user
on that network happens to visit. Two checks prevent that, before any route runs:

- The Host header must be a name that no stranger can point at this machine (DNS rebinding): an IP address, a name
  without dots, a name under a local-only domain, this machine's own name, or one that was allowed explicitly.
- A request for data, or one that changes something, must not come from another site's page (Origin, Sec-Fetch-Site):
  some answers take seconds to compute, whether the page can read them or not. Programs send neither header. A link to
  a report may be followed from anywhere.

No CORS header is ever sent, so scripts of other sites cannot read answers either.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable, Iterable
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from servo_daemon.api.problems import refusal

#: Nothing on these pages comes from anywhere else, and nothing runs that is not a file of the dashboard.
_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
SECURITY_HEADERS: Final = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
_SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
#: What is answered from a daemon's records; of it, what is read in a window of its own.
_DATA: Final = ("/api/", "/metrics")
_DOCUMENTS: Final = "/diagnosis/report"
_OTHER_SITES: Final = frozenset({"cross-site", "same-site"})
#: Domains that public DNS does not serve (RFC 6761, RFC 6762, RFC 8375, ICANN's .internal) or that home routers use.
_LOCAL_DOMAINS: Final = (".localhost", ".local", ".internal", ".home.arpa", ".lan")
_DEFAULT_PORTS: Final = {"http": 80, "https": 443}


def split_host(host: str) -> tuple[str, int | None]:
    """Name and port of a Host header or an origin's authority; the name lower-case, without brackets and final dot.

    Raises:
        ValueError: a port that is no number.
    """
    parts = urlsplit(f"//{host}")
    return (parts.hostname or "").rstrip("."), parts.port


def host_is_ours(host: str, allowed: Iterable[str]) -> bool:
    """Whether this Host header cannot be a stranger's name for this machine."""
    try:
        name, _ = split_host(host)
    except ValueError:
        return False
    try:
        ipaddress.ip_address(name.partition("%")[0])
    except ValueError:
        return bool(name) and ("." not in name or name.endswith(_LOCAL_DOMAINS) or name in set(allowed))
    return True


def origin_is_ours(origin: str, host: str) -> bool:
    """Whether a page of `origin` was served by the server that `host` names. "null" (a sandboxed page) is not."""
    try:
        parts = urlsplit(origin)
        default = _DEFAULT_PORTS.get(parts.scheme)
        name, port = split_host(host)
        return (
            default is not None
            and (parts.hostname or "").rstrip(".") == name
            and (parts.port or default) == (port or default)
        )
    except ValueError:
        return False


class Guard:
    """ASGI middleware: the two checks, and the security headers on every answer.

    Args:
        allowed_hosts: names that were allowed explicitly, as they are now.
    """

    def __init__(self, app: ASGIApp, allowed_hosts: Callable[[], Iterable[str]]) -> None:
        self.app, self._allowed_hosts = app, allowed_hosts
        self._own = socket.gethostname()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)  # a report admits its own script by hash, and nothing else
            await send(message)

        refused = self._refusal(scope)
        answer = self.app if refused is None else refusal(scope["path"], *refused)
        await answer(scope, receive, send_guarded)

    def _refusal(self, scope: Scope) -> tuple[int, str, str] | None:
        """Status, code and detail where the request is refused."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        allowed = {name.lower().rstrip(".") for name in (self._own, *self._allowed_hosts())}
        if host and not host_is_ours(host, allowed):
            detail = f"This daemon does not answer to the host name {host!r}; use its IP address or a local name."
            return 421, "foreign_host", detail
        path, safe = scope["path"], scope["method"] in _SAFE_METHODS
        if safe and not path.startswith(_DATA):
            return None  # page and files
        if safe and path.endswith(_DOCUMENTS) and headers.get("sec-fetch-dest") == "document":
            return None
        origin = headers.get("origin")
        if (origin is not None and not origin_is_ours(origin, host)) or (
            headers.get("sec-fetch-site") in _OTHER_SITES and origin is None
        ):
            return 403, "foreign_origin", "Pages of other sites may neither ask for data here nor change anything."
        return None
