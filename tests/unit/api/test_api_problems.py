"""Every way to be refused: a problem document (RFC 9457) that says what was wrong and what there is instead."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from servo_daemon.api.access.permission import Access
from servo_daemon.api.app import create_app
from tests.fake_daemon import FakeDaemon, FakeDrive, fake_daemon
from tests.http_rig import Client

AXIS1 = "/api/v1/drives/axis1"
HISTORY = AXIS1 + "/history"


def problem(response: httpx.Response, status: int) -> dict[str, Any]:
    """The document, after checking what every problem has."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = response.json()
    assert document["type"] == "about:blank"
    assert document["status"] == status
    assert document["instance"] == response.request.url.path
    assert document["title"]
    assert document["code"]
    assert document["detail"]
    return document


@pytest.fixture
def client() -> Client:
    return Client(create_app(fake_daemon("axis1", "axis2")))


@pytest.mark.parametrize("path", ["/nothing", "/api/v1", "/api/v1/", "/api/v1/drive", AXIS1 + "/", AXIS1 + "/diagnose"])
def test_unknown_path(client: Client, path: str) -> None:
    document = problem(client.get(path), 404)
    assert document["code"] == "unknown_path"
    assert document["title"] == "Not Found"
    assert path in document["detail"]


@pytest.mark.parametrize(
    ("path", "meant"),
    [("/fleet", "/api/v1/fleet"), ("/drives/axis1/trend", AXIS1 + "/trend"), (AXIS1 + "/histroy", AXIS1 + "/history"),
     (AXIS1 + "/", AXIS1)],
)  # fmt: skip
def test_the_path_that_was_meant_is_named(client: Client, path: str, meant: str) -> None:
    assert f"(did you mean {meant}?)" in problem(client.get(path), 404)["detail"]


@pytest.mark.parametrize("path", ["", "/estimates", "/history?parameter=R", "/events", "/stream"])
def test_unknown_drive_names_the_drives_there_are(client: Client, path: str) -> None:
    document = problem(client.get("/api/v1/drives/axis9" + path), 404)
    assert document["code"] == "unknown_drive"
    assert document["known"] == ["axis1", "axis2"]
    assert "axis1, axis2" in document["detail"]


def test_reset_of_an_unknown_drive(client: Client) -> None:
    assert problem(client.post("/api/v1/drives/axis9/reset"), 404)["known"] == ["axis1", "axis2"]


def test_wrong_method_names_the_right_one(client: Client) -> None:
    response = client.post(AXIS1 + "/estimates")
    assert problem(response, 405)["code"] == "method_not_allowed"
    assert response.headers["allow"] == "GET, HEAD"
    assert client.get(AXIS1 + "/reset").headers["allow"] == "POST"
    assert client.request("DELETE", AXIS1 + "/diagnosis").headers["allow"] == "GET, HEAD, POST"


@pytest.mark.parametrize(
    ("query", "parameter"),
    [
        ("", "parameter"),
        ("?parameter=R&points=1", "points"),
        ("?parameter=R&points=many", "points"),
        ("?parameter=R&points=99999999", "points"),
        ("?parameter=R&start=yesterday", "start"),
        ("?parameter=R&end=-600", "end"),
        ("?parameter=R&start=1e300", "start"),
        ("?parameter=R&start=nan", "start"),
        ("?parameter=R&start=now&end=-1h", "start"),
    ],
)
def test_a_parameter_that_makes_no_sense_is_named(client: Client, query: str, parameter: str) -> None:
    document = problem(client.get(HISTORY + query), 422)
    assert document["code"] == "invalid_parameter"
    assert [e["parameter"] for e in document["errors"]] == [parameter]
    assert document["errors"][0]["location"] == "query"
    assert f"'{parameter}'" in document["detail"]


def test_a_parameter_without_history_names_those_with(client: Client) -> None:
    document = problem(client.get(HISTORY + "?parameter=Q"), 422)
    assert document["known"][:5] == ["R", "L", "K", "J", "B"]
    assert "velocity_rad_s" in document["known"]
    assert "'Q'" in document["detail"]


@pytest.mark.parametrize(("name", "unit"), [("R", "Ω"), ("B", "N·m·s/rad"), ("current_A", "A")])
def test_before_the_first_samples_a_history_is_empty(name: str, unit: str) -> None:
    """A page that asks as soon as the daemon answers has made no mistake."""
    client = Client(create_app(FakeDaemon({"axis1": FakeDrive()})))
    answer = client.get(f"{HISTORY}?parameter={name}")
    assert answer.status_code == 200
    document = answer.json()
    assert (document["parameter"], document["unit"], document["points"]) == (name, unit, 0)
    assert document["time"] == document["value"] == document["std"] == []
    assert document["status"] == ([] if name != "current_A" else None)
    assert "Q" not in problem(client.get(HISTORY + "?parameter=Q"), 422)["known"]


class _BrokenDrive(FakeDrive):
    def events(self) -> Any:
        raise RuntimeError("a secret of the implementation")


def test_a_failure_says_so_and_nothing_more() -> None:
    client = Client(create_app(FakeDaemon({"axis1": _BrokenDrive()})))
    response = client.get(AXIS1 + "/events")
    assert problem(response, 500)["code"] == "internal_error"
    assert "secret" not in response.text
    assert "Traceback" not in response.text
    assert client.get(AXIS1 + "/estimates").status_code == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:9", "null", "http://[", "nonsense"])
def test_other_sites_may_not_post(origin: str) -> None:
    daemon = fake_daemon()
    response = Client(create_app(daemon)).post(AXIS1 + "/reset", headers={"Origin": origin})
    assert problem(response, 403)["code"] == "foreign_origin"
    assert daemon.drives["axis1"].resets == 0


@pytest.mark.parametrize("path", ["/metrics", AXIS1 + "/tuning", "/api/v1/openapi.json"])
def test_other_sites_may_not_let_us_work(client: Client, path: str) -> None:
    """As an image of their page, or by a script that may not read the answer."""
    for headers in ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}, {"Origin": "http://evil.example"}):
        assert problem(client.get(path, headers=headers), 403)["code"] == "foreign_origin"
    assert client.get("/", headers={"Sec-Fetch-Site": "cross-site"}).status_code == 200, "a link to the page"
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "document"}
    assert problem(client.get(AXIS1 + "/diagnosis/report", headers=link), 404)["code"] == "no_report"


def test_a_cross_site_post_without_origin_is_refused(client: Client) -> None:
    problem(client.post(AXIS1 + "/reset", headers={"Sec-Fetch-Site": "cross-site"}), 403)


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1:8077", "http://127.0.0.1:8077"),
        ("LOCALHOST:8077", "http://localhost:8077"),
        ("servo.local", "https://servo.local"),
        ("servo.local:443", "https://servo.local"),
        ("[::1]:8077", "http://[::1]:8077"),
        ("127.0.0.1:8077", None),
    ],
)
def test_our_own_page_and_programs_may_post(host: str, origin: str | None) -> None:
    daemon = fake_daemon()
    headers = {"Host": host} | ({"Origin": origin} if origin else {})
    assert Client(create_app(daemon)).post(AXIS1 + "/reset", headers=headers).status_code == 202
    assert daemon.drives["axis1"].resets == 1


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8077", "127.0.0.1.evil.example", "x.local.evil.example"]
)
@pytest.mark.parametrize("path", ["/", "/metrics", AXIS1 + "/estimates"])
def test_names_that_strangers_can_point_here_are_refused(client: Client, host: str, path: str) -> None:
    document = problem(client.get(path, headers={"Host": host}), 421)
    assert document["code"] == "foreign_host"
    assert host in document["detail"]


@pytest.mark.parametrize(
    "host", ["servo", "servo:80", "10.0.0.7", "[fe80::1]:8077", "drive.lan", "servo.home.arpa", "a.local."]
)
def test_local_names_and_addresses_are_ours(client: Client, host: str) -> None:
    assert client.get("/api/v1/health", headers={"Host": host}).status_code == 200


def test_more_hosts_can_be_allowed() -> None:
    client = Client(create_app(fake_daemon(), Access(hosts=("Servo.Example.com",))))
    assert client.get("/api/v1/health", headers={"Host": "servo.example.com"}).status_code == 200
    assert client.get("/api/v1/health", headers={"Host": "other.example.com"}).status_code == 421


@pytest.mark.parametrize("path", ["/", "/metrics", AXIS1 + "/estimates", "/nothing", "/api/v1/openapi.json"])
def test_every_answer_is_for_this_site_only(client: Client, path: str) -> None:
    headers = client.get(path, headers={"Origin": "http://evil.example"}).headers
    assert "access-control-allow-origin" not in headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    policy = dict(part.strip().split(" ", 1) for part in headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
