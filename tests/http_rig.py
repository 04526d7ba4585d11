"""The API under test: asked directly, or served by a real uvicorn on a free port of the loopback interface."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import uvicorn
from starlette.types import ASGIApp

BASE = "http://127.0.0.1:8077"


class Client:
    """Requests to an application without a server between. A failing route answers 500, as it would be served."""

    def __init__(self, app: ASGIApp) -> None:
        self._transport = httpx.ASGITransport(app=app, raise_app_exceptions=False)

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        async def ask() -> httpx.Response:
            async with httpx.AsyncClient(transport=self._transport, base_url=BASE) as client:
                return await client.request(method, path, **options)

        return asyncio.run(ask())

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.request("GET", path, **options)

    def post(self, path: str, **options: Any) -> httpx.Response:
        return self.request("POST", path, **options)


@contextmanager
def serving(app: ASGIApp, port: int = 0) -> Iterator[str]:
    """The application behind a real server; gives its address, and stops it at the end (at the latest after 5 s)."""
    with socket.create_server(("127.0.0.1", port)) as listener:
        settings: dict[str, Any] = {"log_level": "error", "access_log": False, "ws": "none", "lifespan": "off"}
        server = uvicorn.Server(uvicorn.Config(app, timeout_graceful_shutdown=2, **settings))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, name="uvicorn")
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(5)
            assert not thread.is_alive(), "the server did not stop"
