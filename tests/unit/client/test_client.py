"""Both clients against the real API over made-up drives."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from servo_daemon.api.app import create_app
from servo_daemon.api.documents import encode, estimates_document
from servo_daemon.api.stream import frame
from servo_daemon.client import AsyncClient, Client, DaemonError, Estimates, UnreachableError
from servo_daemon.client import steps as steps_module
from servo_daemon.published.archive import KeptCapture
from servo_daemon.published.diagnosis_state import Diagnosis
from servo_daemon.published.snapshot import Event
from servo_daemon.published.view import ModelChange
from servo_daemon.samples import make_block
from tests.fake_daemon import RUNNING, T0, FakeCaptures, FakeDaemon, fake_daemon, make_snapshot
from tests.http_rig import BASE


class _Sync(httpx.BaseTransport):
    """The application, called without a server between."""

    def __init__(self, app: Any) -> None:
        self._inner = httpx.ASGITransport(app=app)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        async def ask() -> httpx.Response:
            answer = await self._inner.handle_async_request(request)
            return httpx.Response(answer.status_code, headers=answer.headers, content=await answer.aread())

        return asyncio.run(ask())


class Both:
    """Calls the method of the name on both clients and gives what both say."""

    def __init__(self, daemon: FakeDaemon) -> None:
        self.app = create_app(daemon)
        self.client = Client(BASE, transport=_Sync(self.app))

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            async def ask() -> Any:
                async with AsyncClient(BASE, transport=httpx.ASGITransport(app=self.app)) as client:
                    found = getattr(client, name)(*arguments, **options)
                    return [e async for e in found] if name == "events" else await found

            one = getattr(self.client, name)(*arguments, **options)
            one, other = (list(one) if name == "events" else one), asyncio.run(ask())
            assert repr(one) == repr(other)
            return one

        return call


@pytest.fixture
def daemon() -> FakeDaemon:
    made = fake_daemon("axis1", "axis 2")
    for k in range(30):
        made.drives["axis1"].publish(make_snapshot(t=2 + k / 10))
    return made


@pytest.fixture
def both(daemon: FakeDaemon) -> Iterator[Both]:
    made = Both(daemon)
    yield made
    made.client.close()


def test_estimates(both: Both) -> None:
    estimates = both.estimates("axis1")
    assert both.drives() == ("axis1", "axis 2") and both.estimates("axis 2").drive == "axis 2"
    assert estimates["R"].unit == "Ω" and estimates["R"].status == "tracking"
    assert estimates.time == datetime.fromtimestamp(T0 + 4.9, UTC)
    assert list(estimates.parameters) == ["R", "L", "K", "J", "B"]
    assert [d["name"] for d in both.get("/fleet")["drives"]] == ["axis1", "axis 2"]


@pytest.mark.parametrize("names", [("R",), ("R", "velocity_rad_s")])
def test_history_as_arrays_and_as_a_table(both: Both, names: tuple[str, ...]) -> None:
    history = both.history("axis1", *names, start=datetime.fromtimestamp(T0, UTC))
    assert history.time.dtype == np.dtype("datetime64[ms]") and len(history) == 31 == len(history["R"].value)
    assert history["R"].unit == "Ω" and set(history["R"].status) == {"tracking"} and history["R"].min is None
    table = history.to_pandas()
    assert list(table.columns)[:3] == ["R", "R_std", "R_status"]
    assert str(table.index.tz) == "UTC" and table["R"].tolist() == history["R"].value.tolist()
    if len(names) > 1:
        assert list(table.columns)[3:] == ["velocity_rad_s"]


def test_buckets_have_their_columns(both: Both) -> None:
    history = both.history("axis1", "R", "K", points=5)
    assert history.period_s > 0 and history["K"].count.sum() == 31
    assert list(history.to_pandas().columns)[:6] == ["R", "R_std", "R_min", "R_max", "R_spread", "R_count"]


def test_events_and_new_ones(both: Both, daemon: FakeDaemon) -> None:
    log = daemon.drives["axis1"].log
    log.extend(Event(T0 + k, ("alarm", "refreshed")[k % 2], f"event {k}", {"value": k}) for k in range(4))
    assert [e.message for e in both.events("axis1")] == [f"event {k}" for k in range(4)]
    assert [e.data for e in both.events("axis1", "alarm", since="2026-11-21T12:00:01Z")] == [{"value": 2}]
    following = both.client.events("axis1", follow=True, poll_s=0.0)
    assert len(list(itertools.islice(following, 4))) == 4
    log.append(Event(T0 + 3, "alarm", "in the same millisecond", {}))
    log.append(Event(T0 + 9, "alarm", "later", {}))
    assert [e.message for e in itertools.islice(following, 2)] == ["in the same millisecond", "later"]


def test_a_diagnosis_is_waited_for(both: Both, daemon: FakeDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = daemon.drives["axis1"]
    monkeypatch.setattr(steps_module, "_LOOK_EVERY_S", 0.001)
    result = {"schema": 1, "verdict": "found", "effects": [{"name": "coulomb_friction", "parameters": {}}]}
    done = replace(drive.diagnosis, diagnosis=Diagnosis("done", "request", (), T0, T0 + 9, result=result))
    for name in ("sync", "async"):
        steps: list[float | None] = []

        def told(d: Any, steps: list[float | None] = steps) -> None:
            steps.append(d.progress)
            drive.diagnosis = done

        if name == "sync":
            found = both.client.diagnose("axis1", told=told)
        else:

            async def ask(told: Any = told) -> Any:
                async with AsyncClient(BASE, transport=httpx.ASGITransport(app=both.app)) as client:
                    return await client.diagnose("axis1", told=told)

            found = asyncio.run(ask())
        assert (found.verdict, found.effects, steps) == ("found", ("coulomb_friction",), [RUNNING.progress])
    with pytest.raises(TimeoutError, match="it goes on"):
        both.client.diagnose("axis1", timeout_s=0.002)


def test_the_model(both: Both, daemon: FakeDaemon) -> None:
    assert both.model("axis1").effects == ()
    daemon.drives["axis1"].outcome = ModelChange(("coulomb_friction",), T0)
    model = both.set_model("axis1", ["coulomb_friction"], {"Tc": 0.01})
    assert model.effects == ("coulomb_friction",) and model.done
    assert daemon.drives["axis1"].asked[0] == (("coulomb_friction",), {"Tc": (0.01, None)})


def test_refusals_and_silence_are_told(both: Both) -> None:
    with pytest.raises(DaemonError, match="There is no drive 'axis9'") as caught:
        both.client.estimates("axis9")
    assert (caught.value.status, caught.value.code) == (404, "unknown_drive")
    with pytest.raises(DaemonError, match="'Rx' has no history"):
        both.client.history("axis1", "Rx")
    with pytest.raises(ValueError, match="at least one"):
        both.client.history("axis1")
    with Client("http://127.0.0.1:9", timeout_s=1.0) as nobody, pytest.raises(UnreachableError, match="no daemon"):
        nobody.drives()


@pytest.fixture
def kept(daemon: FakeDaemon, tmp_path: Path) -> FakeCaptures:
    path = tmp_path / "20261121T120000000Z-60000ms-alarm.parquet"
    path.write_bytes(b"samples")
    daemon.captures = FakeCaptures([KeptCapture(path.name.partition(".")[0], "axis1", "alarm", T0, T0 + 60, 7, path)])
    return daemon.captures


def test_captures_are_listed_downloaded_and_made(kept: FakeCaptures, both: Both) -> None:
    (capture,) = both.captures("axis1")
    assert (capture.kind, capture.size) == ("alarm", 7) and (capture.end - capture.start).total_seconds() == 60
    assert capture.file == f"axis1-{kept.captures[0].path.name}"
    assert both.capture("axis1", capture) == both.capture("axis1", capture.id) == b"samples"
    assert both.record("axis1", 12) == capture and kept.asked == [12.0] * 2
    with pytest.raises(DaemonError, match="no capture 'no-such'") as refused:
        both.client.capture("axis1", "no-such")
    assert refused.value.code == "unknown_capture"


def test_samples_as_arrays(both: Both, daemon: FakeDaemon) -> None:
    time_s = np.arange(100) / 100
    daemon.drives["axis1"].ring.append(make_block(time_s, current_A=np.sin(9 * time_s)))
    found = both.samples("axis1", 0.5, trigger="current_A", level=0.5, before=0.1)
    assert found["current_A"].shape == found.time_s.shape and 10 < len(found.time_s) <= 51
    assert found.trigger_s is not None and np.interp(found.trigger_s, found.time_s, found["current_A"]) >= 0.5
    assert both.samples("axis 2").time_s.shape == (0,) and both.samples("axis 2").trigger_s is None


def test_a_reset_and_a_report_that_is_not_there(both: Both, daemon: FakeDaemon) -> None:
    assert both.reset("axis1") is None
    with pytest.raises(DaemonError) as refused:
        both.client.report("axis1")
    assert refused.value.status == 404


def test_the_stream_gives_estimates_until_it_ends() -> None:
    drive = fake_daemon("axis1").drives["axis1"]
    snapshots = [make_snapshot(t=2.0), make_snapshot(t=2.5)]
    asked: list[httpx.Request] = []

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request)
        if request.url.path.endswith("/axis9/stream"):
            return httpx.Response(404, json={"detail": "There is no drive 'axis9'.", "code": "unknown_drive"})
        frames = [frame(s, encode(estimates_document(drive, s))) for s in snapshots]
        return httpx.Response(200, content=b"retry: 2000\n\n" + b": still here\n\n".join(frames))

    async def all_of(client: AsyncClient) -> list[Estimates]:
        return [e async for e in client.stream("axis1")]

    one = list(Client(BASE, transport=httpx.MockTransport(answer), token="secret").stream("axis1"))
    other = asyncio.run(all_of(AsyncClient(BASE, transport=httpx.MockTransport(answer), token="secret")))
    assert [e.time for e in one] == [datetime.fromtimestamp(T0 + t, UTC) for t in (2.0, 2.5)]
    assert repr(one) == repr(other) and one[0]["R"].unit == "Ω"
    assert {request.headers["authorization"] for request in asked} == {"Bearer secret"}
    with pytest.raises(DaemonError, match="no drive 'axis9'"):
        next(Client(BASE, transport=httpx.MockTransport(answer)).stream("axis9"))


def test_every_route_is_within_reach(daemon: FakeDaemon) -> None:
    """What has a document of its own is asked for by `get`; everything else needs a method."""
    methods = {"reset", "model", "diagnosis", "captures", "captures/{capture}", "diagnosis/report", "stream"}
    routes = create_app(daemon).openapi()["paths"]
    other = {
        path.partition("{drive}/")[2]
        for path, operations in routes.items()
        for verb, operation in operations.items()
        if path.startswith("/api")
        and (verb != "get" or "application/json" not in operation["responses"]["200"].get("content", {}))
    }
    assert other == methods
