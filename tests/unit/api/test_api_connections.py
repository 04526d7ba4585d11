"""Connections are counted, and end when nothing comes of them. A transport and a clock of the test's own; no socket."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
import uvicorn
from uvicorn.server import ServerState

from servo_daemon.api.access.connections import HEAD_S, STALLED_S, ConnectionTable, bounded_protocol

HEAD = b"GET / HTTP/1.1\r\nHost: a\r\n"


class Line(asyncio.Transport):
    """What a connection is told to do."""

    def __init__(self, address: str) -> None:
        super().__init__()
        self.address, self.written, self.closed, self.aborted = address, b"", False, False

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return (self.address, 4711) if name == "peername" else default

    def write(self, data: Any) -> None:
        self.written += data

    def close(self) -> None:
        self.closed = True

    def abort(self) -> None:
        self.closed = self.aborted = True

    def is_closing(self) -> bool:
        return self.closed

    def pause_reading(self) -> None:
        pass

    def resume_reading(self) -> None:
        pass


class Loop:
    """Timers that the test lets go off."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.real, self.timers = loop, []  # type: ignore[var-annotated]

    def call_later(self, delay_s: float, call: Callable[[], None]) -> asyncio.TimerHandle:
        timer = self.real.call_later(3600.0, call)
        self.timers.append((delay_s, timer, call))
        return timer

    def create_task(self, work: Any) -> asyncio.Task[None]:
        return self.real.create_task(work)

    def pass_s(self, seconds: float) -> None:
        due, self.timers = [t for t in self.timers if t[0] <= seconds], [t for t in self.timers if t[0] > seconds]
        for _, timer, call in due:
            if not timer.cancelled():
                call()


class Server:
    def __init__(self, most: int) -> None:
        self.table = ConnectionTable(most)
        self.loop, self.state = Loop(asyncio.get_running_loop()), ServerState()
        bounded = bounded_protocol(self.table)
        self.config = uvicorn.Config(self.app, http=bounded, ws="none", interface="asgi3", log_level="error")
        self.config.load()
        self.asked, self.go_on = 0, asyncio.Event()

    async def app(self, scope: Any, receive: Any, send: Any) -> None:
        self.asked += 1
        await self.go_on.wait()
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    def connect(self, address: str = "10.0.0.1") -> tuple[Any, Line]:
        made: Any = self.config.http_protocol_class
        protocol = made(config=self.config, server_state=self.state, app_state={}, _loop=self.loop)
        protocol.connection_made(line := Line(address))
        return protocol, line


def run(test: Callable[[Server], Any], most: int = 8) -> None:
    async def inside() -> None:
        server = Server(most)
        await test(server)
        server.go_on.set()
        for protocol in list(server.state.connections):
            protocol.connection_lost(None)

    asyncio.run(inside())


def test_more_than_there_is_room_for_are_refused_in_words() -> None:
    async def inside(server: Server) -> None:
        mine = [server.connect() for _ in range(6)]
        assert [line.closed for _, line in mine] == [False] * 4 + [True] * 2, "half for one address"
        assert mine[-1][1].written.startswith(b"HTTP/1.1 503 ") and b"Retry-After" in mine[-1][1].written
        others = [server.connect(f"10.0.1.{k}")[1].closed for k in range(6)]
        assert others == [False] * 4 + [True] * 2
        mine[-1][0].connection_lost(None)
        mine[0][0].connection_lost(None)
        assert server.table.open.total() == 7 and not server.connect("10.0.2.1")[1].closed

    run(inside)


def test_a_head_that_does_not_end_is_not_waited_for() -> None:
    async def inside(server: Server) -> None:
        silent, slow = server.connect(), server.connect()
        for byte in HEAD:
            slow[0].data_received(bytes([byte]))
        server.loop.pass_s(HEAD_S)
        for _, line in (silent, slow):
            assert line.closed and line.written.startswith(b"HTTP/1.1 408 "), line.written
        assert server.asked == 0

    run(inside)


def test_a_head_is_limited_also_behind_a_request_that_is_being_answered() -> None:
    async def inside(server: Server) -> None:
        first, busy = server.connect(), server.connect()
        busy[0].data_received(HEAD + b"\r\n")
        for protocol, line in (first, busy):
            protocol.data_received(HEAD + b"X: ")
            fed = 0
            while not line.closed:
                protocol.data_received(b"y" * 4096)
                fed += 4096
                assert fed < 100_000
        assert first[1].written.startswith(b"HTTP/1.1 431 ") and busy[1].aborted

    run(inside)


def test_a_request_is_answered_and_its_body_is_no_head() -> None:
    async def inside(server: Server) -> None:
        protocol, line = server.connect()
        protocol.data_received(b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 60000\r\n\r\n")
        protocol.data_received(b"z" * 60_000)
        server.loop.pass_s(HEAD_S)
        assert not line.closed, "it takes long, and that is not the client's fault"
        server.go_on.set()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert line.written.startswith(b"HTTP/1.1 204") and not line.closed
        protocol.data_received(HEAD)
        server.loop.pass_s(HEAD_S)
        assert line.closed, "the next head is waited for as long as the first"

    run(inside)


@pytest.mark.parametrize("reads", [True, False])
def test_a_client_that_takes_nothing_has_gone(reads: bool) -> None:
    async def inside(server: Server) -> None:
        protocol, line = server.connect()
        protocol.data_received(HEAD + b"\r\n")
        protocol.pause_writing()
        if reads:
            protocol.resume_writing()
        server.loop.pass_s(STALLED_S)
        assert line.aborted is not reads

    run(inside)
