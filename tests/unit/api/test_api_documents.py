"""Every document: its shape against the published schema, and nothing in it that JSON cannot hold."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import pytest
from pydantic import BaseModel

from servo_daemon.api.app import create_app
from servo_daemon.api.schemas import estimates as schemas
from servo_daemon.api.schemas import past
from servo_daemon.published.snapshot import EstimatorView, Event, ParameterEstimate
from tests.fake_daemon import NOMINAL, T0, TRUE, FakeDaemon, fake_daemon, make_estimate, make_snapshot
from tests.http_rig import Client

API = "/api/v1"


def strict(response: httpx.Response) -> Any:
    """The document, refusing NaN and infinities that Python's parser would let pass."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} in {response.text}")

    return json.loads(response.text, parse_constant=refuse)


def ask(daemon: FakeDaemon, path: str, status: int = 200) -> Any:
    response = Client(create_app(daemon)).get(path)
    assert response.status_code == status, response.text
    return strict(response)


DOCUMENTS: list[tuple[str, type[BaseModel]]] = [
    ("/health", schemas.HealthDocument),
    ("/ready", schemas.ReadyDocument),
    ("/drives", schemas.DrivesDocument),
    ("/fleet", past.FleetDocument),
    ("/drives/axis1", schemas.DriveDocument),
    ("/drives/axis1/estimates", schemas.EstimatesDocument),
    ("/drives/axis1/history?parameter=R", past.HistoryDocument),
    ("/drives/axis1/history?parameter=current_A", past.HistoryDocument),
    ("/drives/axis1/history?parameter=R,K,current_A", past.HistoriesDocument),
    ("/drives/axis1/events", past.EventsDocument),
]


@pytest.mark.parametrize(("path", "schema"), DOCUMENTS, ids=[path for path, _ in DOCUMENTS])
def test_documents_are_what_the_schema_says(path: str, schema: type[BaseModel]) -> None:
    daemon = fake_daemon()
    daemon.drives["axis1"].log.append(Event(T0, "connected", "port opened", {"attempts": 2, "after_s": 1.5}))
    response = Client(create_app(daemon)).get(API + path)
    assert response.status_code == 200
    assert response.headers["content-type"] == "application/json"
    assert response.headers["cache-control"] == ("no-cache" if schema.__module__ == past.__name__ else "no-store")
    document = schema.model_validate(strict(response))
    assert json.loads(document.model_dump_json(exclude_unset=True)) == strict(response)


def test_estimates_are_the_contract() -> None:
    document = ask(fake_daemon(), API + "/drives/axis1/estimates")
    assert list(document) == [
        "drive",
        "time",
        "samples",
        "sample_rate_hz",
        "model",
        "parameters",
        "state",
        "estimators",
        "health",
    ]
    assert document["drive"] == "axis1"
    assert document["time"] == "2026-11-21T12:00:01.000Z"
    assert list(document["parameters"]) == ["R", "L", "K", "J", "B"]
    assert list(document["parameters"]["R"]) == ["value", "std", "unit", "nominal", "status", "reason", "age_s"]
    assert document["parameters"]["R"]["unit"] == "Ω"
    assert document["parameters"]["R"]["nominal"] == NOMINAL["R"]
    assert set(document["state"]) == {"current_A", "velocity_rad_s", "position_rad"}
    assert set(document["estimators"]["ekf"]) == {"parameters", "detail"}
    assert set(document["estimators"]["ekf"]["parameters"]["R"]) == {"value", "std"}
    assert document["health"]["innovation_white"] is True
    assert document["health"]["samples_lost"] == 0
    assert document["health"]["connection"] == "connected"


def test_before_the_first_samples_nominal_values_are_estimating() -> None:
    daemon = fake_daemon(published=False)
    document = ask(daemon, API + "/drives/axis1/estimates")
    schemas.EstimatesDocument.model_validate(document)
    assert document["time"] is None
    assert document["samples"] == 0
    for name, parameter in document["parameters"].items():
        assert parameter["value"] == parameter["nominal"] == NOMINAL[name]
        assert parameter["std"] is None
        assert parameter["status"] == "estimating"
        assert parameter["reason"]
    assert document["health"]["connection"] == "connecting"
    assert document["health"]["connection_reason"] == "port is opened"


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, np.float64("nan"), np.float32("inf")])
def test_what_is_not_finite_becomes_null(bad: float) -> None:
    daemon = fake_daemon()
    drive = daemon.drives["axis1"]
    parameters = (ParameterEstimate("R", bad, bad, "Ω", bad, "invalid", "broken", bad),)
    estimate = make_estimate(
        2.0,
        parameters,
        sample_rate_hz=bad,
        state={"current_A": bad},
        estimators={"ekf": EstimatorView({"R": (bad, bad)}, {"detail": bad})},
        health={"nis": bad, "innovation_white": np.True_, "resets": np.int64(3)},
    )
    drive.publish(make_snapshot(t=2.0, estimate=estimate, truth={"R": bad}))
    drive.log.append(Event(T0, "jump", "R jumped", {"by": bad}))
    document = ask(daemon, API + "/drives/axis1/estimates")
    assert document["parameters"]["R"] == {
        "value": None,
        "std": None,
        "unit": "Ω",
        "nominal": None,
        "status": "invalid",
        "reason": "broken",
        "age_s": None,
    }
    assert document["sample_rate_hz"] is None
    assert document["state"] == {"current_A": None}
    assert document["estimators"]["ekf"] == {
        "parameters": {"R": {"value": None, "std": None}},
        "detail": {"detail": None},
    }
    assert document["health"]["nis"] is None
    assert document["health"]["innovation_white"] is True
    assert document["health"]["resets"] == 3
    assert ask(daemon, API + "/drives/axis1")["truth"] == {"R": None}
    history = ask(daemon, API + "/drives/axis1/history?parameter=R")
    assert history["value"][-1] is None
    assert history["truth"][-1] is None
    assert ask(daemon, API + "/drives/axis1/events")["events"][0]["data"] == {"by": None}


def test_an_answer_is_encoded_once_per_snapshot() -> None:
    daemon = fake_daemon()
    client = Client(create_app(daemon))
    first = client.get(API + "/drives/axis1/estimates")
    assert client.get(API + "/drives/axis1/estimates").content == first.content
    # An equal but new snapshot is a new document; so is one of which only the connection changed.
    drive = daemon.drives["axis1"]
    drive.lose("down", "unplugged")
    document = strict(client.get(API + "/drives/axis1/estimates"))
    assert document["health"]["connection"] == "down"
    assert {p["status"] for p in document["parameters"].values()} == {"invalid"}


def test_drives_are_listed_in_order_and_told_apart() -> None:
    daemon = fake_daemon("zeta", "alpha")
    listed = ask(daemon, API + "/drives")["drives"]
    assert [d["name"] for d in listed] == ["zeta", "alpha"]
    assert listed[0]["driver"] == "simulated"
    assert ask(daemon, API + "/drives/alpha/estimates")["drive"] == "alpha"
    assert ask(daemon, API + "/drives/zeta/estimates")["drive"] == "zeta"


def test_truth_is_shown_of_simulated_drives_only() -> None:
    daemon = fake_daemon()
    assert ask(daemon, API + "/drives/axis1")["truth"] == TRUE
    real = daemon.drives["axis1"]
    real.publish(make_snapshot(t=2.0, driver="serial", truth=None))
    assert "truth" not in ask(daemon, API + "/drives/axis1")


def test_history_filters_by_time_and_thins() -> None:
    daemon = fake_daemon(published=False)
    drive = daemon.drives["axis1"]
    for k in range(100):
        drive.publish(make_snapshot(t=1 + k / 10))
    path = API + "/drives/axis1/history?parameter=R"
    everything = ask(daemon, path)
    assert everything["points"] == 100 == len(everything["time"]) == len(everything["std"])
    assert everything["unit"] == "Ω"
    assert set(everything["status"]) == {"tracking"}
    assert everything["truth"] == [TRUE["R"]] * 100
    part = ask(daemon, f"{path}&start={T0 + 2}&end={T0 + 3}")
    assert part["points"] == 11
    assert part["time"] == everything["time"][10:21]
    same = ask(daemon, f"{path}&start={part['time'][0]}&end={part['time'][-1]}")
    assert same == part
    assert ask(daemon, f"{path}&start={T0 + 1000}")["points"] == 0
    thin = ask(daemon, f"{path}&points=10")
    assert thin["points"] <= 10
    assert set(thin["value"]) <= set(everything["value"])
    assert max(thin["value"]) == max(everything["value"])
    state = ask(daemon, API + "/drives/axis1/history?parameter=velocity_rad_s")
    assert state["unit"] == "rad/s"
    assert state["status"] is None
    assert state["std"] == [None] * 100


def test_health_is_of_the_daemon_not_of_a_drive() -> None:
    daemon = fake_daemon("a", "b")
    daemon.drives["a"].lose("down", "unplugged")
    document = ask(daemon, API + "/health")
    assert document["status"] == "ok"
    assert document["drives"] == {"a": "down", "b": "connected"}
    daemon.wrong = ("the pipeline has not turned for 7 s",)
    document = ask(daemon, API + "/health", 503)
    schemas.HealthDocument.model_validate(document)
    assert document["status"] == "failing"
    assert document["problems"] == ["the pipeline has not turned for 7 s"]


def test_ready_from_the_first_samples_of_any_drive_on() -> None:
    daemon = fake_daemon("a", "b", published=False)
    document = ask(daemon, API + "/ready", 503)
    assert document["code"] == "not_ready"
    assert "a: port is opened" in document["detail"]
    assert document["drives"]["b"] == {"ready": False, "connection": "connecting", "reason": "port is opened"}
    daemon.drives["b"].publish(make_snapshot("b"))
    assert ask(daemon, API + "/ready")["ready"] is True
    # It stays ready: a drive that is switched off must not take the daemon out of service.
    daemon.drives["b"].lose("silent", "nothing arrives")
    assert ask(daemon, API + "/ready")["drives"]["b"]["connection"] == "silent"


def test_it_is_not_ready_while_the_only_drive_is_down() -> None:
    daemon = fake_daemon()
    daemon.drives["axis1"].lose("down", "unplugged")
    document = ask(daemon, API + "/ready", 503)
    assert document["drives"]["axis1"] == {"ready": False, "connection": "down", "reason": "unplugged"}


def test_the_history_up_to_now_holds_nothing_of_the_future() -> None:
    """The clock was an hour fast when the first row was made."""
    daemon, now = fake_daemon(published=False), time.time()
    for t in (now + 3600.0, now - 2.0, now - 1.0):
        daemon.drives["axis1"].publish(replace(make_snapshot(t=1.0), time=t))
    rows = ask(daemon, API + "/drives/axis1/history?parameter=R&start=-10min")
    assert len(rows["time"]) == 2
    assert len(ask(daemon, API + "/drives/axis1/history?parameter=R&end=2100-01-01")["time"]) == 2


def test_a_restored_estimate_without_samples_is_not_ready() -> None:
    daemon = fake_daemon()
    drive = daemon.drives["axis1"]
    drive.current = replace(drive.snapshot(), time=None)
    assert ask(daemon, API + "/ready", 503)["ready"] is False


def test_reset_is_asked_for_once() -> None:
    daemon = fake_daemon()
    response = Client(create_app(daemon)).post(API + "/drives/axis1/reset")
    assert response.status_code == 202
    assert strict(response) == {"drive": "axis1", "accepted": True}
    assert daemon.drives["axis1"].resets == 1
