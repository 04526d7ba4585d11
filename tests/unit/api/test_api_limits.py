"""What one request may say: larger, deeper and slower ones are refused before a route or a parser sees them."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest

from servo_daemon.api.access import request_limits
from servo_daemon.api.access.request_limits import MAX_BODY, MAX_DEPTH, RequestLimits, too_deep
from servo_daemon.api.app import create_app
from tests.fake_daemon import fake_daemon
from tests.http_rig import Client
from tests.unit.api.test_api_problems import problem

MODEL = "/api/v1/drives/axis1/model"
JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def client() -> Client:
    return Client(create_app(fake_daemon()))


def test_a_body_within_the_limit_is_read(client: Client) -> None:
    response = client.post(MODEL, content=b"[" + b" " * (MAX_BODY - 1), headers=JSON)
    assert "not JSON" in problem(response, 422)["detail"]


def test_a_body_that_says_it_is_larger_is_refused_unread(client: Client) -> None:
    response = client.post(MODEL, content=b" " * (MAX_BODY + 1), headers=JSON)
    assert problem(response, 413)["code"] == "body_too_large"
    assert response.headers["connection"] == "close"
    assert response.headers["content-security-policy"], "the guard's headers are on it too"


def test_chunks_are_counted_as_they_come() -> None:
    """No length is given, and the client never ends: it is asked for no more than the limit and one chunk."""
    asked, sent = 0, []

    async def receive() -> dict[str, Any]:
        nonlocal asked
        asked += 1
        return {"type": "http.request", "body": b" " * 4096, "more_body": True}

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "POST", "path": MODEL, "query_string": b""}
    scope["headers"] = [(b"transfer-encoding", b"chunked")]  # type: ignore[assignment]
    asyncio.run(RequestLimits(create_app(fake_daemon()))(scope, receive, send))  # type: ignore[arg-type]
    assert sent[0]["status"] == 413
    assert asked == MAX_BODY // 4096 + 1


def test_a_body_that_does_not_come_is_not_waited_for(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request_limits, "BODY_S", 0.0)

    async def never() -> Any:
        yield b"{"
        await asyncio.Event().wait()

    assert problem(client.post(MODEL, content=never(), headers=JSON), 408)["code"] == "too_slow"


def test_nesting_is_limited(client: Client) -> None:
    deep = b'{"effects": ' + b"[" * 30_000 + b"]" * 30_000 + b"}"
    assert "nested" in problem(client.post(MODEL, content=deep, headers=JSON), 422)["detail"]
    assert not too_deep(b"[" * MAX_DEPTH + b"]" * MAX_DEPTH) and too_deep(b"[" * (MAX_DEPTH + 1))
    assert not too_deep(json.dumps({"k": '"[[\\' * 9999 + "[" * 99}).encode()), "brackets in a string"
    assert not too_deep(b'"' + b'\\"' * 30_000), "a string without an end, in linear time"


def test_addresses_and_headers_are_limited(client: Client) -> None:
    assert problem(client.get("/api/v1/drives?x=" + "y" * 9000), 414)["code"] == "url_too_long"
    assert problem(client.get("/api/v1/drives", headers={"X-Pad": "y" * 40_000}), 431)["code"] == "headers_too_large"


def test_half_of_a_surrogate_pair_is_refused_in_words(client: Client) -> None:
    body = b'{"effects": [], "\\ud800": 1}'
    problem(client.post(MODEL, content=body, headers=JSON), 422)


def test_what_is_no_text_is_refused_as_openapi_says(client: Client) -> None:
    assert problem(client.post(MODEL, content=b'{"effects": ["\xff"]}', headers=JSON), 422)["errors"]
