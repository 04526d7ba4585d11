"""`/history`, `/events` and `/fleet` over a store on disk: the same past in every form."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest

from servo_daemon.api.app import create_app
from servo_daemon.api.fleet import KEPT_S, FleetEncoder
from servo_daemon.api.schemas import kept
from servo_daemon.api.schemas import past as schemas
from servo_daemon.published.archive import ArchiveUnavailableError
from servo_daemon.published.snapshot import Event, ParameterEstimate
from tests.fake_daemon import T0, FakeDaemon, fake_daemon, make_estimate, make_snapshot, parameters_at
from tests.http_rig import Client
from tests.unit.history.world import World

HISTORY = "/api/v1/drives/axis1/history"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    """Eleven minutes, and nothing of them in memory."""
    made = World.in_folder(tmp_path_factory.mktemp("past"))
    made.run(660.0)
    made.restart()
    return made


def daemon_over(world: World) -> FakeDaemon:
    daemon = fake_daemon(published=False)
    daemon.archive = world.archive
    return daemon


@pytest.fixture(scope="module")
def client(world: World) -> Client:
    return Client(create_app(daemon_over(world)))


def get(client: Client, query: str, status: int = 200, **headers: str) -> Any:
    response = client.get(f"{HISTORY}?{query}", headers=headers)
    assert response.status_code == status, response.text
    return response


def test_after_a_restart_the_rows_are_there(client: Client, world: World) -> None:
    document = get(client, f"parameter=R&start={T0}&points=20000").json()
    schemas.HistoryDocument.model_validate(document)
    assert (document["level"], document["period_s"], document["points"]) == ("rows", 0, 6600)
    assert document["value"] == pytest.approx(list(world.truth.values()), abs=0.01 / 16)
    assert set(document["status"]) == {"tracking"} and document["min"] is None
    assert len(document["truth"]) == 6600 and document["note"] is None
    thinned = get(client, f"parameter=R&start={T0}&points=100").json()
    assert (
        thinned["points"] <= 100 and thinned["level"] == "1 s" and min(thinned["min"]) == pytest.approx(0.4, abs=2e-3)
    )


def test_several_series_share_their_times(client: Client) -> None:
    document = get(client, f"parameter=R,current_A&end={T0 + 660}&window=10min&points=50&level=1%20s").json()
    schemas.HistoriesDocument.model_validate(document)
    assert document["level"] == "1 s" and document["period_s"] > 1 and 25 <= document["points"] <= 50
    R, current = document["series"]["R"], document["series"]["current_A"]
    assert R["share"] == {"tracking": [1.0] * document["points"]} and current["status"] is None
    assert all(low <= mean <= high for low, mean, high in zip(R["min"], R["value"], R["max"], strict=True))
    assert sum(R["count"]) == pytest.approx(6000, abs=20)


@pytest.mark.parametrize("accept", ["text/csv", "application/json;q=0.5, text/csv", "text/html, text/csv;q=0.9"])
def test_csv(client: Client, accept: str) -> None:
    query = f"parameter=R,current_A,L&start={T0}&level=1%20min"
    response = get(client, query, accept=accept)
    assert response.headers["content-type"] == "text/csv; charset=utf-8"
    rows = list(csv.DictReader(io.StringIO(response.text)))
    document = get(client, query).json()
    assert [row["time"] for row in rows] == document["time"]
    assert [float(row["R"]) for row in rows] == document["series"]["R"]["value"]
    assert list(rows[0]) == [
        "time", "R", "R_std", "R_min", "R_max", "R_spread", "R_count", "R_status",
        "current_A", "current_A_min", "current_A_max", "current_A_spread", "current_A_count",
        "L", "L_std", "L_min", "L_max", "L_spread", "L_count", "L_status",
    ]  # fmt: skip
    assert {row["L"] for row in rows} == {""} and {row["R_status"] for row in rows} == {"tracking"}


def test_parquet(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    query = f"parameter=R&start={T0}&level=1%20s"
    response = get(client, f"parameter=R,L&start={T0}&level=1%20s", accept="application/vnd.apache.parquet")
    table = pyarrow.parquet.read_table(io.BytesIO(response.content))
    table.validate(full=True)
    assert table["L"].null_count == table["L_count"].null_count == table["L_status"].null_count == len(table)
    document = get(client, query).json()
    assert table["R"].to_pylist() == document["value"] and table["R_count"].to_pylist() == document["count"]
    assert table["time"][0].as_py().isoformat(timespec="milliseconds").replace("+00:00", "Z") == document["time"][0]
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    problem = get(client, query, 406, accept="application/vnd.apache.parquet").json()
    assert problem["code"] == "no_parquet" and "servo-daemon[parquet]" in problem["detail"]


_IN_A_FRESH_PROCESS = """
import sys
from dataclasses import replace
from servo_daemon.api.past import spans
from servo_daemon.published.history import HistoryRing
from servo_daemon.published.memory import memory_span
from tests.fake_daemon import make_estimate, make_snapshot, parameters_at
ring = HistoryRing()
for t in (1.0, 2.0, 3.0):
    parameters = [replace(p, value=None) if t == 2.0 else p for p in parameters_at(t)]
    ring.append(make_snapshot(t=t, estimate=make_estimate(t, parameters)))
table, _ = spans.encode(memory_span(ring, ["R"], 0.0, 1e12), ["R"], {"R"}, "parquet")
sys.stdout.buffer.write(table)
sys.exit("pandas" in sys.modules)
"""


def test_parquet_does_not_load_pandas() -> None:
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", _IN_A_FRESH_PROCESS], cwd=root, check=True, capture_output=True, timeout=60
    )
    table = pyarrow.parquet.read_table(io.BytesIO(done.stdout))
    assert table["R"].to_pylist() == [parameters_at(1.0)[0].value, None, parameters_at(3.0)[0].value]
    assert table["R_status"].to_pylist() == ["tracking"] * 3


def test_what_the_client_has_is_not_sent_again(client: Client) -> None:
    query = f"parameter=R&start={T0}&end={T0 + 100}"
    first = get(client, query)
    again = client.get(f"{HISTORY}?{query}", headers={"if-none-match": f'"other", W/{first.headers["etag"]}'})
    assert (again.status_code, again.content) == (304, b"") and again.headers["etag"] == first.headers["etag"]
    other = get(client, f"parameter=R&start={T0}&end={T0 + 99}", **{"if-none-match": first.headers["etag"]})
    assert other.headers["etag"] != first.headers["etag"]


@pytest.mark.parametrize(
    ("query", "says"),
    [
        ("parameter=R,", "a name is missing"),
        ("parameter=Rx,R", "'Rx' has no history; known are R, L"),
        ("parameter=R&window=1y&start=-1d", "not both"),
        ("parameter=R&window=1year", "30min or 1y"),
        ("parameter=R&level=2h", "the levels are rows, 1 s, 1 min, 1 h"),
        ("parameter=" + ",".join(f"P{k}" for k in range(70)), "at most 64"),
    ],
)
def test_what_makes_no_sense_is_refused(client: Client, query: str, says: str) -> None:
    problem = get(client, query, 422).json()
    assert says in problem["detail"] and problem["code"] == "invalid_parameter"


class _Gone:
    """An archive that is out of reach."""

    def __getattr__(self, name: str) -> Any:
        def ask(*_: object) -> Any:
            raise ArchiveUnavailableError("the disk is away")

        return ask


def test_while_the_store_is_away_memory_answers_and_says_so() -> None:
    daemon = fake_daemon()
    daemon.archive = _Gone()  # type: ignore[assignment]
    drive = daemon.drives["axis1"]
    for k in range(20):
        drive.publish(make_snapshot(t=2 + k / 10))
    drive.log.append(Event(T0, "connected", "here", {}))
    client = Client(create_app(daemon))
    for parameter in ("R", "R,K"):
        document = get(client, f"parameter={parameter}&window=30y").json()
        assert document["points"] == 21 and document["note"] == "the disk is away"
    assert get(client, "parameter=R&window=30y", 503, accept="text/csv").json()["code"] == "history_unavailable"
    assert [e["kind"] for e in client.get("/api/v1/drives/axis1/events").json()["events"]] == ["connected"]


def test_without_a_store_several_series_come_from_memory() -> None:
    daemon = fake_daemon()
    for k in range(40):
        daemon.drives["axis1"].publish(make_snapshot(t=2 + k / 10))
    client = Client(create_app(daemon))
    document = get(client, "parameter=R,velocity_rad_s&points=10").json()
    assert document["period_s"] > 0 and document["points"] <= 10 and sum(document["series"]["R"]["count"]) == 41
    assert "no [history]" in get(client, "parameter=R&level=1%20h", 422).json()["detail"]


def test_memory_hides_what_a_clock_that_was_ahead_has_dated() -> None:
    daemon = fake_daemon()
    drive = daemon.drives["axis1"]
    drive.publish(make_snapshot(t=5000.0))
    drive.publish(make_snapshot(t=3.0))
    client = Client(create_app(daemon))
    assert get(client, "parameter=R").json()["points"] == 2
    assert get(client, "parameter=R,K").json()["points"] == 2
    assert get(client, f"parameter=R&end={T0 + 9000}").json()["time"][-1].endswith("12:00:03.000Z")


def test_events_are_paged_and_chosen(world: World) -> None:
    daemon = daemon_over(world)
    for k in range(7):
        world.drives[0].log.add(("alarm", "connected")[k % 2], f"event {k}")
    world.turn()
    world.drives[0].log.add("alarm", "event 7")
    world.now, before = T0 * 1e3, world.now
    client = Client(create_app(daemon))

    def events(query: str) -> Any:
        response = client.get(f"/api/v1/drives/axis1/events?{query}")
        assert response.status_code == 200, response.text
        return schemas.EventsDocument.model_validate(response.json())

    daemon.archive = world.archive
    client = Client(create_app(daemon))
    seen: list[str] = []
    page = events("limit=3")
    while True:
        seen = [e.message for e in page.events] + seen
        if page.next is None:
            break
        page = events(f"limit=3&before={page.next}")
    assert seen == [f"event {k}" for k in range(8)]
    assert [e.message for e in events("kinds=connected,none").events] == ["event 1", "event 3", "event 5"]
    assert events("since=2100-01-01").events == []
    for bad in ("limit=0", "limit=5000", "before=x", "since=soon", "kinds=a,,b"):
        assert client.get(f"/api/v1/drives/axis1/events?{bad}").status_code == 422, bad
    world.now = before


def test_the_fleet_says_what_to_look_at_first() -> None:
    daemon = fake_daemon("well", "rings", "away", "new")
    for name in ("well", "rings"):
        parameters = (
            ParameterEstimate("R", 1.3, 0.01, "Ω", 1.0, "tracking"),
            ParameterEstimate("K", 0.9, 0.01, "N·m/A", 1.0, "unexcited"),
            ParameterEstimate("J", 9.0, None, "kg·m²", 1.0, "estimating"),
        )
        health = {"alarms": "K_min,controller_margin"} if name == "rings" else {"alarms": None}
        estimate = make_estimate(2.0, parameters, health=health)
        daemon.drives[name].publish(make_snapshot(name, t=2.0, estimate=estimate, truth=None))
    daemon.drives["away"].lose("down", "unplugged")
    daemon.drives["new"].current = None
    document = Client(create_app(daemon)).get("/api/v1/fleet").json()
    schemas.FleetDocument.model_validate(document)
    drives = {d["name"]: d for d in document["drives"]}
    assert list(drives) == ["well", "rings", "away", "new"]
    assert drives["well"]["worst"] == {"parameter": "R", "why": "+30.0 % from nominal"}
    assert drives["well"]["statuses"] == {"tracking": 1, "unexcited": 1, "estimating": 1}
    assert drives["well"]["parameters"]["J"]["change_percent"] is None
    assert drives["rings"]["worst"] == {"parameter": "K", "why": "alarm K_min"}
    assert drives["rings"]["alarms"] == ["K_min", "controller_margin"]
    assert drives["away"]["worst"]["why"] == "unplugged" and drives["away"]["connection"] == "down"
    assert drives["new"]["worst"] is None
    assert not drives["well"]["simulated"] and drives["away"]["simulated"]


def test_an_answer_serves_all_who_ask_at_nearly_the_same_time() -> None:
    daemon, now_s = fake_daemon(), [100.0]
    encode = FleetEncoder(daemon, lambda: now_s[0])
    first = encode()
    daemon.drives["axis1"].publish(make_snapshot(t=2.0))
    now_s[0] += 0.9 * KEPT_S
    assert encode() is first
    now_s[0] += 0.1 * KEPT_S
    assert json.loads(encode())["drives"][0]["time"] == "2026-11-21T12:00:02.000Z"


def test_diagnoses_and_models_that_are_kept_for_good(tmp_path: Path) -> None:
    world = World.in_folder(tmp_path)
    world.run(3.0)
    world.diagnose({"verdict": "found", "effects": [{"name": "coulomb_friction", "parameters": {}}]})
    world.drives[0].model = ("coulomb_friction",)
    world.turn()
    client = Client(create_app(daemon_over(world)))
    drive = "/api/v1/drives/axis1"
    document = client.get(f"{drive}/diagnoses").json()
    kept.DiagnosesDocument.model_validate(document)
    (short,) = document["diagnoses"]
    assert (short["verdict"], short["effects"], short["model"]) == ("found", ["coulomb_friction"], [])
    whole = client.get(short["url"]).json()
    kept.KeptDiagnosisDocument.model_validate(whole)
    assert whole["result"]["effects"] == [{"name": "coulomb_friction", "parameters": {}}]
    models = client.get(f"{drive}/models").json()
    kept.ModelsDocument.model_validate(models)
    assert [(m["effects"], m["before"]) for m in models["models"]] == [(["coulomb_friction"], [])]
    assert client.get(f"{drive}/diagnoses/99").json()["code"] == "unknown_diagnosis"


def test_without_a_store_the_answer_says_why_nothing_is_kept() -> None:
    client = Client(create_app(fake_daemon()))
    assert client.get("/api/v1/drives/axis1/models").json()["models"] == []
    assert "state_dir" in client.get("/api/v1/drives/axis1/diagnoses").json()["reason"]
    assert client.get("/api/v1/drives/axis1/diagnoses/1").status_code == 404
