"""A browser, and the page of a fake daemon whose drives publish ten times a second, behind a real server."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from starlette.types import Receive, Scope, Send

from servo_daemon.api.app import create_app
from tests.browser.devtools import Browser, Page, browsing
from tests.fake_daemon import FakeDaemon, FakeDrive, live_snapshot
from tests.http_rig import serving

#: Published before a page is opened: it must load this from the history, s.
PAST_S = 40.0


class LiveServer:
    """Two drives that publish, a server that can be stopped and started again, and a list of what was asked
    and how many streams are open."""

    def __init__(self) -> None:
        self.started = time.time() - PAST_S
        self.daemon = FakeDaemon({"axis1": FakeDrive("axis1"), "axis2": FakeDrive("axis2")})
        self.asked: list[str] = []
        self.streams = 0
        self.paused: set[str] = set()
        self._end = threading.Event()
        self._stack = ExitStack()
        for drive in self.daemon.drives.values():
            for k in range(int(PAST_S * 10)):
                drive.publish(live_snapshot(drive.name, self.started, self.started + k / 10))
        self._thread = threading.Thread(target=self._publish, name="drives")
        self._thread.start()
        self.address = ""
        self.serve()

    @property
    def axis1(self) -> FakeDrive:
        return self.daemon.drives["axis1"]

    def _publish(self) -> None:
        while not self._end.wait(0.1):
            for drive in self.daemon.drives.values():
                if drive.name not in self.paused:
                    drive.publish(live_snapshot(drive.name, self.started))

    def serve(self) -> None:
        """Start serving; on the same port as before."""
        self.daemon.stop = False
        app = create_app(self.daemon)

        async def recorded(scope: Scope, receive: Receive, send: Send) -> None:
            if scope["type"] == "http":
                query = scope["query_string"].decode()
                self.asked.append(scope["path"] + (f"?{query}" if query else ""))
            stream = scope.get("path", "").endswith("/stream")
            self.streams += stream
            try:
                await app(scope, receive, send)
            finally:
                self.streams -= stream

        port = int(self.address.rsplit(":", 1)[1]) if self.address else 0
        self.address = self._stack.enter_context(serving(recorded, port))

    def stop_serving(self) -> None:
        self.daemon.stop = True
        self._stack.close()

    def close(self) -> None:
        self.stop_serving()
        self._end.set()
        self._thread.join(5)


@pytest.fixture(scope="session")
def browser(program: Callable[..., str]) -> Iterator[Browser]:
    with browsing(program("chromium", "chromium-browser", "google-chrome")) as browser:
        yield browser


@pytest.fixture
def server(browser: Browser) -> Iterator[LiveServer]:
    server = LiveServer()
    try:
        yield server
    finally:
        server.close()


@pytest.fixture
def open_page(browser: Browser, server: LiveServer) -> Iterator[Callable[..., Page]]:
    """`open_page(width=1280, dark=False)`: the dashboard, its charts drawn. Closed at the end."""
    pages = []

    def opened(width: int = 1280, fragment: str = "#axis1", seen: bool = False, **look: Any) -> Page:
        page = Page(browser)
        pages.append(page)
        if seen:
            page.be_seen()
        page.look(width, 900, **look)
        page.open(server.address + "/" + fragment)
        page.until("document.querySelectorAll('#parameters .card').length == 5")
        page.until("document.getElementById('connection').dataset.state == 'connected'")
        page.until("document.querySelector('[data-name=R] .number').textContent != '–'")
        return page

    yield opened
    for page in pages:
        page.close()
