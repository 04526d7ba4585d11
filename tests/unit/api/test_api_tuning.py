"""`GET /drives/{d}/tuning`: its document, what it refuses, and that it is computed rarely, not in the event loop."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from dataclasses import replace
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from servo_daemon.api import tuning as api_tuning
from servo_daemon.api.app import create_app
from servo_daemon.api.schemas import tuning as tuning_schemas
from servo_daemon.published.knowledge import LoopFacts
from servo_daemon.tuning import report
from servo_daemon.tuning.knowledge import Ask, CascadeGains
from tests.fake_daemon import NOMINAL, TRUE, FakeDaemon, fake_daemon, make_estimate, make_snapshot, parameters_at
from tests.http_rig import BASE, Client
from tests.unit.api.test_api_documents import strict

PATH = "/api/v1/drives/axis1/tuning"
GAINS = CascadeGains(1.2, 84.0, filter_hz=120.0)


class Here:
    """Computes in a thread of this process, so that the test sees what is computed. One at a time, as the process."""

    def __init__(self) -> None:
        self.turn = asyncio.Lock()

    async def run(self, function: Any, *arguments: object) -> Any:
        async with self.turn:
            return await asyncio.get_running_loop().run_in_executor(None, function, *arguments)

    def close(self) -> None:
        pass


def app_of(daemon: FakeDaemon) -> FastAPI:
    return create_app(daemon, computer=Here())


def ask(daemon: FakeDaemon, query: str = "", status: int = 200) -> Any:
    response = Client(app_of(daemon)).get(PATH + query)
    assert response.status_code == status, response.text
    return strict(response)


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[Ask]:
    """What was computed, in order."""
    asks: list[Ask] = []
    real = report.tune

    def spy(motor: Any, setup: Any, asked: Ask, nominal: Any) -> Any:
        asks.append(asked)
        return real(motor, setup, asked, nominal)

    monkeypatch.setattr(report, "tune", spy)
    return asks


@pytest.mark.parametrize("in_use", [None, GAINS, CascadeGains(50.0, 1000.0), CascadeGains(0.6, 43.0, 9.0)])
def test_the_document_is_what_the_schema_says(in_use: CascadeGains | None) -> None:
    daemon = fake_daemon()
    daemon.drives["axis1"].loop = LoopFacts(in_use=in_use, nominal=NOMINAL, voltage_V=24.0, counts_per_rev=4096)
    response = Client(app_of(daemon)).get(PATH)
    assert response.status_code == 200
    assert response.headers["content-type"] == "application/json" and response.headers["cache-control"] == "no-store"
    document = tuning_schemas.TuningDocument.model_validate(strict(response))
    assert json.loads(document.model_dump_json(exclude_unset=True)) == strict(response)


def test_what_it_says_of_the_drive() -> None:
    daemon = fake_daemon()
    daemon.drives["axis1"].loop = LoopFacts(in_use=GAINS, nominal=NOMINAL, ask=Ask(bandwidth_hz=3.0))
    document = ask(daemon)
    assert (document["drive"], document["time"]) == ("axis1", "2026-11-21T12:00:01.000Z")
    assert document["parameters"]["R"]["source"] == "estimate" and document["rate_source"] == "measured"
    assert document["region"].startswith("95% ellipsoid") and document["not_in_region"] == []
    for design in document["designs"].values():
        assert design["response"]["bandwidth_hz"] == pytest.approx(3.0, rel=1e-3)
        assert design["worst"]["phase_margin_deg"] < design["margins"]["phase_margin_deg"]
        assert set(design["worst"]["at"]["phase_margin_deg"]) == set(TRUE)
    assert document["in_use"]["gains"]["speed_kp_V_s_rad"] == 1.2
    assert document["in_use"]["nominal"]["stable"] is True
    assert document["margin_low"] is None


def test_the_request_may_ask_for_something_else() -> None:
    daemon = fake_daemon()
    daemon.drives["axis1"].loop = LoopFacts(nominal=NOMINAL, ask=Ask(bandwidth_hz=3.0))
    fast = ask(daemon, "?bandwidth_hz=2")
    assert fast["asked"] == {"bandwidth_hz": 2.0, "settling_s": None}
    assert fast["designs"]["lqr"]["response"]["bandwidth_hz"] == pytest.approx(2.0, rel=1e-3)
    slow = ask(daemon, "?settling_s=0.5")
    assert slow["designs"]["speed_pi"]["response"]["settling_s"] == pytest.approx(0.5, abs=0.003)


@pytest.mark.parametrize(
    ("query", "says"),
    [
        ("?bandwidth_hz=0", "greater than 0"),
        ("?bandwidth_hz=nan", "finite"),
        ("?bandwidth_hz=fast", "number"),
        ("?bandwidth_hz=3&settling_s=1", "not both"),
        ("?bandwidth_hz=400", "ask for at most 100.02 Hz"),
        ("?settling_s=0.0001", "ask for at least"),
    ],
)
def test_an_impossible_ask_is_refused(query: str, says: str) -> None:
    problem = ask(fake_daemon(), query, 422)
    assert problem["code"] == "invalid_parameter" and says in problem["detail"]


def test_an_impossible_configuration_is_a_conflict() -> None:
    daemon = fake_daemon()
    daemon.drives["axis1"].loop = LoopFacts(nominal=NOMINAL, ask=Ask(bandwidth_hz=400.0))
    assert ask(daemon, status=409)["code"] == "tuning_impossible"


def test_what_is_not_known_is_a_conflict_that_names_it() -> None:
    daemon = fake_daemon()
    shown = tuple(
        replace(p, nominal=None, status="estimating", reason="the speed is constant") if p.name == "J" else p
        for p in parameters_at(1.0)
    )
    daemon.drives["axis1"].publish(make_snapshot(t=2.0, estimate=make_estimate(2.0, shown)))
    problem = ask(daemon, status=409)
    assert problem["code"] == "tuning_impossible" and "J (the speed is constant)" in problem["detail"]


def test_before_the_first_samples_nominal_values_need_a_rate() -> None:
    daemon = fake_daemon(published=False)
    assert "rate is not known" in ask(daemon, status=409)["detail"]
    daemon.drives["axis1"].loop = LoopFacts(nominal=NOMINAL, rate_hz=2000.0)
    document = ask(daemon)
    assert document["time"] is None and document["region"] is None
    assert {p["source"] for p in document["parameters"].values()} == {"nominal"}
    assert all(d["worst"] is None for d in document["designs"].values())


def test_an_unknown_drive_is_unknown() -> None:
    response = Client(app_of(fake_daemon())).get("/api/v1/drives/axis9/tuning")
    assert response.status_code == 404 and response.json()["code"] == "unknown_drive"


def test_polling_computes_once(computed: list[Ask]) -> None:
    daemon = fake_daemon()
    client = Client(app_of(daemon))
    first = client.get(PATH).content
    for k in range(5):
        daemon.drives["axis1"].publish(make_snapshot(t=2.0 + k))
        assert client.get(PATH).content == first
    assert len(computed) == 1
    client.get(PATH + "?bandwidth_hz=2")
    assert len(computed) == 2, "another ask"


def test_it_is_computed_again_when_a_status_changes_or_it_is_old(
    computed: list[Ask], monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = fake_daemon()
    client = Client(app_of(daemon))
    client.get(PATH)
    estimate = make_estimate(2.0, parameters_at(2.0, "unexcited"))
    daemon.drives["axis1"].publish(make_snapshot(t=2.0, estimate=estimate))
    client.get(PATH)
    assert len(computed) == 2
    now = time.monotonic()
    monkeypatch.setattr(api_tuning.time, "monotonic", lambda: now + api_tuning.FRESH_S + 1.0)
    client.get(PATH)
    assert len(computed) == 3


def test_many_at_once_are_one_computation_and_the_loop_stays_free(computed: list[Ask]) -> None:
    """While it computes, another request is answered: the computation waits for that answer."""
    answered = threading.Event()
    release = report.tune

    def slow(*arguments: Any) -> Any:
        assert answered.wait(10), "the event loop was blocked"
        return release(*arguments)

    async def ask_all() -> list[httpx.Response]:
        transport = httpx.ASGITransport(app=app_of(fake_daemon()))
        async with httpx.AsyncClient(transport=transport, base_url=BASE) as client:
            tasks = [asyncio.create_task(client.get(PATH)) for _ in range(8)]
            await asyncio.sleep(0)
            health = await client.get("/api/v1/health")
            answered.set()
            return [health, *await asyncio.gather(*tasks)]

    report.tune = slow  # the fixture puts the real one back
    responses = asyncio.run(ask_all())
    assert {r.status_code for r in responses} == {200}
    assert len({r.content for r in responses[1:]}) == 1 and len(computed) == 1


def test_it_is_computed_as_long_as_somebody_waits_for_it() -> None:
    """Two clients wait for one computation, which ends when the second has gone as well."""

    class Endless:
        running = 0

        async def run(self, function: Any, *arguments: object) -> Any:
            self.running += 1
            try:
                await asyncio.Event().wait()
            finally:
                self.running -= 1

        def close(self) -> None:
            pass

    async def ask_and_go(app: Any, gone: asyncio.Event) -> None:
        first = [{"type": "http.request", "body": b"", "more_body": False}]

        async def receive() -> Any:
            if first:
                return first.pop()
            await gone.wait()
            return {"type": "http.disconnect"}

        async def send(message: Any) -> None:
            pass

        scope = {"type": "http", "method": "GET", "path": PATH, "query_string": b"", "headers": []}
        await app(scope, receive, send)

    async def inside() -> None:
        computer = Endless()
        app = create_app(fake_daemon(), computer=computer)
        gone = [asyncio.Event(), asyncio.Event()]
        clients = [asyncio.create_task(ask_and_go(app, event)) for event in gone]
        while not computer.running:
            await asyncio.sleep(0)
        gone[0].set()
        await clients[0]
        assert computer.running == 1
        gone[1].set()
        await clients[1]
        await asyncio.sleep(0)
        assert computer.running == 0

    asyncio.run(inside())


def test_openapi_describes_it() -> None:
    document = Client(app_of(fake_daemon())).get("/openapi.json").json()
    operation = document["paths"]["/api/v1/drives/{drive}/tuning"]["get"]
    assert {p["name"] for p in operation["parameters"]} == {"drive", "bandwidth_hz", "settling_s"}
    assert set(operation["responses"]) == {"200", "404", "409", "422", "503"}
    assert "TuningDocument" in document["components"]["schemas"]
