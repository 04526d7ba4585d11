"""The page's files as they are served, and the description of the API."""

from __future__ import annotations

import hashlib
import re
from importlib.resources import files
from typing import Any

import pytest

from servo_daemon.api.app import create_app
from servo_daemon.api.assets import load_assets
from servo_daemon.api.schemas import estimates as schemas
from servo_daemon.api.schemas import past
from tests.fake_daemon import fake_daemon
from tests.http_rig import Client

DASHBOARD = files("servo_daemon.api") / "dashboard"


@pytest.fixture(scope="module")
def client() -> Client:
    return Client(create_app(fake_daemon()))


@pytest.mark.parametrize("path", ["/", *(f"/assets/{name}" for name in sorted(load_assets()))])
def test_files_are_asked_for_again_and_sent_only_if_changed(client: Client, path: str) -> None:
    first = client.get(path)
    assert first.status_code == 200
    assert first.headers["cache-control"] == "no-cache"
    tag = first.headers["etag"]
    again = client.get(path, headers={"If-None-Match": f'"other", W/{tag}'})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["etag"] == tag
    assert client.get(path, headers={"If-None-Match": '"other"'}).content == first.content
    head = client.request("HEAD", path)
    assert (head.status_code, head.headers["etag"]) == (200, tag)


@pytest.mark.parametrize("path", ["/metrics", "/api/v1/drives", "/api/v1/drives/axis1/estimates", "/api/v1/nothing"])
def test_head_is_get_without_its_body(client: Client, path: str) -> None:
    get, head = client.get(path), client.request("HEAD", path)
    assert head.content == b""
    assert head.status_code == get.status_code
    assert head.headers["content-type"] == get.headers["content-type"]


def test_head_of_a_stream_ends(client: Client) -> None:
    head = client.request("HEAD", "/api/v1/drives/axis1/stream")
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["content-type"].startswith("text/event-stream")


def test_media_types(client: Client) -> None:
    for path, media_type in (
        ("/", "text/html; charset=utf-8"),
        ("/assets/app.js", "text/javascript; charset=utf-8"),
        ("/assets/style.css", "text/css; charset=utf-8"),
        ("/assets/icon.svg", "image/svg+xml"),
        ("/assets/vendor/uPlot.LICENSE", "text/plain; charset=utf-8"),
    ):
        assert client.get(path).headers["content-type"] == media_type


@pytest.mark.parametrize(
    "path", ["/assets/", "/assets/nothing.js", "/assets/../app.py", "/assets/%2e%2e/app.py", "/assets//etc/passwd"]
)
def test_nothing_else_is_served(client: Client, path: str) -> None:
    response = client.get(path)
    assert response.status_code == 404
    assert response.headers["content-type"] == "application/problem+json"


def test_the_page_needs_nothing_from_elsewhere() -> None:
    """Offline means: no address in any file of ours but the name spaces and the page's own."""
    for name, asset in load_assets().items():
        if name.startswith("vendor/"):
            continue
        addresses = set(re.findall(r"(?:https?:)?//[\w.-]+\.\w+", asset.body.decode()))
        assert addresses <= {"http://www.w3.org"}, name


def test_the_vendored_library_is_what_its_note_says() -> None:
    note = (DASHBOARD / "vendor" / "VENDORED.md").read_text(encoding="utf-8")
    noted = dict(reversed(line.split()) for line in re.findall(r"[0-9a-f]{64}  \S+", note))
    assert set(noted) == {"uPlot.iife.min.js", "uPlot.min.css"}
    for name, digest in noted.items():
        assert hashlib.sha256((DASHBOARD / "vendor" / name).read_bytes()).hexdigest() == digest
    assert "1.6.32" in note
    assert b"v1.6.32" in (DASHBOARD / "vendor" / "uPlot.iife.min.js").read_bytes()[:200]
    assert "MIT" in (DASHBOARD / "vendor" / "uPlot.LICENSE").read_text(encoding="utf-8")


def test_the_api_is_described_on_a_page_that_needs_nothing_from_elsewhere(client: Client) -> None:
    page = client.get("/docs")
    assert page.status_code == 200 and page.headers["content-type"] == "text/html; charset=utf-8"
    for path, item in client.get("/openapi.json").json()["paths"].items():
        for method in item:
            assert f"<b>{method.upper()}</b> <code>{path}</code></h2>" in page.text
    assert "<script" not in page.text and not re.findall(r"(?:src|href)=.(?:https?:)?//", page.text)
    for sheet in re.findall(r'href="(assets/[^"]+)"', page.text):
        assert client.get(f"/{sheet}").status_code == 200
    targets = set(re.findall(r'href="#([^"]+)"', page.text))
    assert targets and targets == set(re.findall(r'<section id="([^"]+)"', page.text))
    assert (
        page.text.count("<code>application/vnd.apache.parquet</code>") <= 1 and "&lt;" not in page.text.split("<pre")[0]
    )


def _references(node: Any) -> set[str]:
    if isinstance(node, dict):
        own = {node["$ref"]} if isinstance(node.get("$ref"), str) else set()
        return own.union(*(_references(v) for v in node.values()))
    if isinstance(node, list):
        return set().union(*(_references(v) for v in node))
    return set()


def test_openapi_describes_every_route_with_examples(client: Client) -> None:
    document = client.get("/openapi.json").json()
    assert client.get("/api/v1/openapi.json").json() == document
    drive = "/api/v1/drives/{drive}"
    assert set(document["paths"]) == {
        "/api/v1/health",
        "/api/v1/ready",
        "/api/v1/drives",
        "/api/v1/fleet",
        drive,
        f"{drive}/estimates",
        f"{drive}/history",
        f"{drive}/events",
        f"{drive}/trend",
        f"{drive}/tuning",
        f"{drive}/diagnosis",
        f"{drive}/diagnosis/report",
        f"{drive}/model",
        f"{drive}/captures",
        f"{drive}/captures/{{capture}}",
        f"{drive}/samples",
        f"{drive}/diagnoses",
        f"{drive}/diagnoses/{{number}}",
        f"{drive}/models",
        f"{drive}/stream",
        f"{drive}/reset",
        "/metrics",
    }
    known = {f"#/components/schemas/{name}" for name in document["components"]["schemas"]}
    assert _references(document) <= known
    assert "#/components/schemas/HTTPValidationError" not in known  # all errors are problem documents
    assert "application/problem+json" in document["paths"][f"{drive}/history"]["get"]["responses"]["422"]["content"]
    for path, item in document["paths"].items():
        for operation in item.values():
            assert operation["description"], path
    for name in ("EstimatesDocument", "HistoryDocument", "FleetDocument", "HealthDocument", "ProblemDocument"):
        (example,) = document["components"]["schemas"][name]["examples"]
        {**vars(schemas), **vars(past)}[name].model_validate(example)
