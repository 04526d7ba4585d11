"""How many connections there are, and how long one may say nothing: uvicorn's protocol with limits of its own.

uvicorn bounds neither the number of connections nor the time and the bytes until a request is complete: 1,300 idle
clients used up the process's file descriptors, and the state could no longer be saved.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

from uvicorn.protocols.http.auto import AutoHTTPProtocol

from servo_daemon.api.access.request_limits import MAX_HEADERS, MAX_URL

log = logging.getLogger(__name__)

#: Connections at a time: the streams there may be (64), and three for each of as many pages. Each costs a descriptor.
MOST_CONNECTIONS: Final = 256
#: Without a complete request for so long a connection ends, s; nginx's `client_header_timeout` is 60, but for anyone.
HEAD_S: Final = 10.0
#: A client that takes nothing of an answer for so long has gone, s.
STALLED_S: Final = 30.0
#: Refusals are told in the log at most this often, s.
_TELL_EVERY_S: Final = 60.0
_HEAD_BYTES: Final = MAX_URL + MAX_HEADERS

_PHRASES: Final = {408: "Request Timeout", 431: "Request Header Fields Too Large", 503: "Service Unavailable"}


@dataclass(slots=True)
class ConnectionTable:
    """The open connections of one server, by the client's address. Used by its event loop only.

    Attributes:
        most: at a time. One address gets half of them, so that no one client keeps all others away.
    """

    most: int = MOST_CONNECTIONS
    open: Counter[str] = field(default_factory=Counter)
    refused: int = 0
    _told: float = -_TELL_EVERY_S

    def take(self, address: str) -> bool:
        """Whether there is room for one more from there; then it is counted."""
        if self.open.total() < self.most and self.open[address] < max(1, self.most // 2):
            self.open[address] += 1
            return True
        self.refused += 1
        if time.monotonic() - self._told >= _TELL_EVERY_S:
            self._told = time.monotonic()
            n, there = self.open.total(), self.open[address]
            log.warning(
                "connections refused: %d are open, %d from %s (%d refused so far)", n, there, address, self.refused
            )
        return False

    def leave(self, address: str) -> None:
        self.open[address] -= 1
        if self.open[address] <= 0:
            del self.open[address]


#: One of uvicorn's two: it is chosen when uvicorn is imported.
_HTTP_PROTOCOL: Any = AutoHTTPProtocol


class _Bounded(_HTTP_PROTOCOL):  # type: ignore[misc]  # no type that mypy knows
    """uvicorn's HTTP/1.1 protocol with the limits above. Its `cycle` is the last request with a complete head; None
    before the first."""

    _table: ConnectionTable  # the server's
    _address: str | None = None  # None: not counted
    _bytes = 0  # beyond the last complete request
    _timer: asyncio.TimerHandle | None = None  # until the next one is
    _stall: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:
        super().connection_made(transport)
        address = str((transport.get_extra_info("peername") or ("local",))[0])
        if self._table.take(address):
            self._address = address
            self._timer = self.loop.call_later(HEAD_S, self._late)
        else:
            self._refuse(503, "Retry-After: 5\r\n")

    def connection_lost(self, exc: Exception | None) -> None:
        for timer in (self._timer, self._stall):
            if timer is not None:
                timer.cancel()
        if self._address is not None:
            self._table.leave(self._address)
            self._address = None
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._address is None or self.transport.is_closing():
            return
        before, body = self.cycle, self.cycle is not None and self.cycle.more_body
        super().data_received(data)
        if self.transport.is_closing():
            return
        if self.cycle is not before:
            self._bytes = 0
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
        elif not body:
            self._bytes += len(data)
            if self._bytes > _HEAD_BYTES:
                self._refuse(431)
            elif self._timer is None and self._is_idle():
                self._timer = self.loop.call_later(HEAD_S, self._late)

    def pause_writing(self) -> None:
        super().pause_writing()
        if self._stall is None:
            self._stall = self.loop.call_later(STALLED_S, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None

    def _is_idle(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _late(self) -> None:
        self._timer = None
        if self._is_idle() and not self.transport.is_closing():
            self._refuse(408)

    def _refuse(self, status: int, header: str = "") -> None:
        """Say so and close; in the middle of an answer only the latter is possible."""
        if not self._is_idle():
            self.transport.abort()
            return
        head = f"HTTP/1.1 {status} {_PHRASES[status]}\r\n{header}Connection: close\r\nContent-Length: 0\r\n\r\n"
        self.transport.write(head.encode())
        self.transport.close()


def bounded_protocol(table: ConnectionTable) -> type[asyncio.Protocol]:
    """The protocol of a server with these connections; for `uvicorn.Config(http=…)`."""

    class Bounded(_Bounded):
        _table = table

    return Bounded
