"""The stream of estimates: its bytes, its pace, and its ends, the last two behind a real server."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import httpx
import pytest

from servo_daemon.api import stream
from servo_daemon.api.app import create_app
from servo_daemon.published.snapshot import Snapshot
from tests.fake_daemon import FakeDaemon, fake_daemon, make_snapshot
from tests.http_rig import serving

PATH = "/api/v1/drives/axis1/stream"


def wait_for(condition: Callable[[], bool], timeout_s: float = 10.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "the condition did not become true"
        time.sleep(0.01)


def parse(lines: Iterator[str]) -> Iterator[dict[str, str]]:
    """Events as the standard reads them; comments as {"comment": ...}, a lone retry as {"retry": ...}."""
    event: dict[str, str] = {}
    for line in lines:
        if line == "":
            yield event
            event = {}
            continue
        name, _, value = line.partition(":")
        event[name or "comment"] = value.removeprefix(" ")


@contextmanager
def following(address: str) -> Iterator[Iterator[dict[str, str]]]:
    with httpx.stream("GET", address + PATH, timeout=10) as response:
        assert response.status_code == 200
        assert response.headers["content-type"].startswith("text/event-stream")
        assert response.headers["cache-control"] == "no-store"
        yield parse(response.iter_lines())


def test_events_follow_the_snapshots() -> None:
    daemon = fake_daemon()
    drive = daemon.drives["axis1"]
    with serving(create_app(daemon)) as address:
        with following(address) as events:
            assert next(events) == {"retry": "2000"}
            first = next(events)
            assert first["event"] == "estimates"
            assert first["id"] == "2026-11-21T12:00:01.000Z"
            assert json.loads(first["data"]) == httpx.get(address + PATH.replace("stream", "estimates")).json()
            drive.publish(make_snapshot(t=2.5))
            second = next(events)
            assert second["id"] == "2026-11-21T12:00:02.500Z"
            assert json.loads(second["data"])["time"] == second["id"]
            drive.lose("down", "unplugged")
            assert json.loads(next(events)["data"])["health"]["connection"] == "down"
        daemon.stop = True


def test_before_the_first_samples_the_id_is_empty() -> None:
    daemon = fake_daemon(published=False)
    with serving(create_app(daemon)) as address, following(address) as events:
        next(events)
        event = next(events)
        assert event["id"] == ""
        assert json.loads(event["data"])["time"] is None
        daemon.stop = True


def test_streams_end_when_the_daemon_stops() -> None:
    daemon = fake_daemon()
    with serving(create_app(daemon)) as address, following(address) as events:
        assert "retry" in next(events)
        assert "data" in next(events)
        daemon.stop = True
        assert list(events) == []


def test_a_client_that_leaves_frees_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream.StreamSlots, "full", property(lambda self: self.open >= 1))
    daemon = fake_daemon()
    with serving(create_app(daemon)) as address:
        with following(address) as events:
            next(events)
            refused = httpx.get(address + PATH)
            assert refused.status_code == 503
            assert refused.headers["retry-after"] == "5"
            assert refused.json()["code"] == "too_many_streams"

        def accepted() -> bool:
            with httpx.stream("GET", address + PATH) as response:
                return response.status_code == 200

        wait_for(accepted)
        daemon.stop = True


class _Clock:
    """Stands in for time and sleep in the stream's module; writes down what happened in which order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.sleeps: list[float] = []
        monkeypatch.setattr(stream, "time", SimpleNamespace(monotonic=lambda: self.now))

        async def sleep(seconds: float) -> None:
            self.now += seconds
            self.sleeps.append(seconds)

        monkeypatch.setattr(stream, "asyncio", SimpleNamespace(sleep=sleep))


def _collect(daemon: FakeDaemon, snapshot: Callable[[], Snapshot], n: int) -> list[bytes]:
    async def collect() -> list[bytes]:
        slots = stream.StreamSlots()
        chunks = stream.estimates_stream(snapshot, lambda s: b"{}", daemon.stopping, slots)
        assert slots.open == 0
        out = [await anext(chunks) for _ in range(n)]
        assert slots.open == 1
        await chunks.aclose()
        assert slots.open == 0
        return out

    return asyncio.run(collect())


def test_at_most_ten_events_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = fake_daemon()
    times = iter(range(1000))
    clock = _Clock(monkeypatch)
    chunks = _collect(daemon, lambda: make_snapshot(t=next(times)), 101)
    assert sum(b"event: estimates" in chunk for chunk in chunks) == 100
    # A sleep of 0.1 s between any two: neither faster than ten a second nor a busy loop.
    assert clock.sleeps == [0.1] * 99


def test_comments_keep_a_quiet_stream_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = fake_daemon()
    clock = _Clock(monkeypatch)
    chunks = _collect(daemon, daemon.drives["axis1"].snapshot, 4)
    assert chunks[0].startswith(b"retry:")
    assert b"event: estimates" in chunks[1]
    assert chunks[2] == chunks[3] == b": still here\n\n"
    assert clock.now == pytest.approx(2 * stream.HEARTBEAT_S, abs=0.3)
