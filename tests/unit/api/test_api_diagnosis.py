"""Diagnosis, report and model over REST: documents, and every way to be refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.api import diagnosis as api_diagnosis
from servo_daemon.api.app import create_app
from servo_daemon.api.schemas import diagnosis as schemas
from servo_daemon.errors import BusyError, ModelError, RefusedError, ServoDaemonError
from servo_daemon.published.diagnosis_state import Adoption, Diagnosis, DiagnosisView
from servo_daemon.published.view import ModelChange
from servo_daemon.report import content_security_policy
from tests.fake_daemon import RUNNING, T0, FakeDaemon, FakeDrive, fake_daemon
from tests.fake_diagnose import document as result
from tests.http_rig import Client
from tests.unit.api.test_api_documents import strict
from tests.unit.api.test_api_problems import problem

AXIS1 = "/api/v1/drives/axis1"
DIAGNOSIS, REPORT, MODEL = f"{AXIS1}/diagnosis", f"{AXIS1}/diagnosis/report", f"{AXIS1}/model"
FORM = "application/x-www-form-urlencoded"
DONE = replace(RUNNING, status="done", finished=T0 + 60, progress=1.0, step=None, result=result("found", 0.0125))
FAILED = replace(RUNNING, status="failed", finished=T0 + 60, reason="ended after its time limit")


@pytest.fixture
def daemon() -> FakeDaemon:
    return fake_daemon("axis1", "axis2")


@pytest.fixture
def client(daemon: FakeDaemon) -> Client:
    return Client(create_app(daemon))


def show(daemon: FakeDaemon, diagnosis: Diagnosis, **changes: Any) -> FakeDrive:
    drive = daemon.drives["axis1"]
    drive.diagnosis = DiagnosisView(diagnosis, Adoption(False), True, None)
    drive.diagnosis = replace(drive.diagnosis, **changes)
    return drive


@pytest.mark.parametrize(
    "state",
    [Diagnosis(), RUNNING, FAILED, DONE, *(replace(DONE, result=result(v, 0.01)) for v in ("none", "unexplained"))],
    ids=["idle", "running", "failed", "found", "none", "unexplained"],
)
def test_the_document_is_what_the_schema_says(daemon: FakeDaemon, client: Client, state: Diagnosis) -> None:
    show(daemon, state, adoption=Adoption(True, ("coulomb_friction",)))
    response = client.get(DIAGNOSIS)
    assert response.status_code == 200 and response.headers["cache-control"] == "no-store"
    document = schemas.DiagnosisDocument.model_validate(strict(response))
    assert json.loads(document.model_dump_json(exclude_unset=True, by_alias=True)) == strict(response)
    assert document.status == state.status
    assert (document.result is None) == (state.result is None)


def test_a_verdict_in_full(daemon: FakeDaemon, client: Client) -> None:
    show(daemon, replace(DONE, report=Path("/x/report.html")), adoption=Adoption(True, ("coulomb_friction",)))
    document = strict(client.get(DIAGNOSIS))
    assert document["drive"] == "axis1" and document["trigger"] == "request" and document["model"] == []
    assert document["started"] == "2026-11-21T12:00:00.000Z" and document["finished"] == "2026-11-21T12:01:00.000Z"
    assert document["result"] == result("found", 0.0125), "as the program wrote it"
    assert document["report"] == REPORT
    assert document["adoption"] == {"allowed": True, "reason": None, "effects": ["coulomb_friction"]}
    assert document["request"] == {"allowed": True, "reason": None}


def test_one_is_begun(daemon: FakeDaemon, client: Client) -> None:
    response = client.post(DIAGNOSIS)
    assert response.status_code == 202
    document = strict(response)
    assert document["status"] == "running" and document["progress"] == 0.35
    assert document["step"] == "round 1: fitting coulomb_friction"


@pytest.mark.parametrize(
    ("refusal", "code"),
    [
        (BusyError("a diagnosis of drive axis2 is running; there is one at a time"), "not_now"),
        (RefusedError('the configuration says diagnose = "never"'), "not_allowed"),
    ],
)
def test_why_none_can_be_begun(daemon: FakeDaemon, client: Client, refusal: Exception, code: str) -> None:
    daemon.drives["axis1"].refusal = refusal
    response = client.post(DIAGNOSIS)
    document = problem(response, 409)
    assert document["code"] == code and str(refusal)[1:] in document["detail"]
    assert ("retry-after" in response.headers) == (code == "not_now")


def test_the_report_is_served_with_its_own_script_and_nothing_else(
    daemon: FakeDaemon, client: Client, tmp_path: Path
) -> None:
    assert problem(client.get(REPORT), 404)["code"] == "no_report"
    page = tmp_path / "report.html"
    show(daemon, replace(DONE, report=page))
    assert problem(client.get(REPORT), 404)["code"] == "no_report", "somebody has deleted it"
    page.write_text("<!doctype html><title>ω</title>", encoding="utf-8")
    response = client.get(REPORT)
    assert response.status_code == 200 and response.text == "<!doctype html><title>ω</title>"
    assert response.headers["content-type"] == "text/html; charset=utf-8"
    assert response.headers["content-security-policy"] == content_security_policy()
    assert response.headers["x-content-type-options"] == "nosniff"


def post(client: Client, **body: Any) -> Any:
    return client.post(MODEL, json=body)


def test_the_model_is_exchanged_and_the_first_estimate_told(daemon: FakeDaemon, client: Client) -> None:
    drive = daemon.drives["axis1"]
    drive.outcome = ModelChange(("coulomb_friction",), T0 + 5)
    parameters = {"Tc": {"value": 0.012, "std": 0.0004}, "R": 1.5, "B": {"value": 0.5}, "channel": "position_rad"}
    response = post(client, effects=["coulomb_friction"], parameters=parameters)
    assert response.status_code == 200
    document = strict(response)
    schemas.ModelDocument.model_validate(document)
    assert document == {
        "drive": "axis1", "model": ["coulomb_friction"], "time": "2026-11-21T12:00:05.000Z", "done": True,
    }  # fmt: skip
    start = {"Tc": (0.012, 0.0004), "R": (1.5, None), "B": (0.5, None), "channel": ("position_rad", None)}
    assert drive.asked == [(("coulomb_friction",), start)]


def test_the_linear_motor_is_a_model_too(daemon: FakeDaemon, client: Client) -> None:
    daemon.drives["axis1"].outcome = ModelChange((), None)
    document = strict(post(client, effects=[]))
    assert document == {"drive": "axis1", "model": [], "time": None, "done": True}


def test_where_no_samples_come_it_does_not_wait(
    daemon: FakeDaemon, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(api_diagnosis, "_SILENT_S", 0.05)
    daemon.drives["axis1"].lose("silent", "nothing arrives")
    response = post(client, effects=["coulomb_friction"])
    assert response.status_code == 202
    assert strict(response) == {"drive": "axis1", "model": ["coulomb_friction"], "time": None, "done": False}


def test_it_does_not_wait_for_ever(daemon: FakeDaemon, client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_diagnosis, "WAIT_S", 0.1)
    assert post(client, effects=["coulomb_friction"]).status_code == 202


@pytest.mark.parametrize(
    ("refusal", "status", "code"),
    [
        (BusyError("another change is under way"), 409, "not_now"),
        (RefusedError("the model is fixed"), 409, "not_allowed"),
        (ServoDaemonError("the pipeline failed"), 409, "not_done"),
    ],
)
def test_why_it_is_not_exchanged(
    daemon: FakeDaemon, client: Client, refusal: Exception, status: int, code: str
) -> None:
    daemon.drives["axis1"].refusal = refusal
    assert problem(post(client, effects=["coulomb_friction"]), status)["code"] == code


def test_what_no_drive_can_have_is_named(daemon: FakeDaemon, client: Client) -> None:
    daemon.drives["axis1"].refusal = ModelError("effects.0", "there is no effect 'x'", ("coulomb_friction",))
    document = problem(post(client, effects=["x"]), 422)
    assert document["code"] == "invalid_parameter" and document["known"] == ["coulomb_friction"]
    assert document["errors"] == [{"location": "body", "parameter": "effects.0", "detail": "there is no effect 'x'"}]
    assert "'effects.0'" in document["detail"]


@pytest.mark.parametrize(
    ("content", "parameter"),
    [
        ("", ""),
        ("{", ""),
        ("null", ""),
        ("[]", ""),
        ("{}", "effects"),
        ('{"effects": "coulomb_friction"}', "effects"),
        ('{"effects": [1]}', "effects.0"),
        ('{"effects": [], "parameter": {}}', "parameter"),
        ('{"effects": [], "parameters": {"Tc": {"std": 1}}}', "parameters.Tc.value"),
        ('{"effects": [], "parameters": {"Tc": {"value": 1, "std": -1}}}', "parameters.Tc.std"),
        ('{"effects": [], "parameters": {"Tc": {"value": 1, "std": true}}}', "parameters.Tc.std"),
        ('{"effects": [], "parameters": {"Tc": {"value": NaN}}}', "parameters.Tc.value"),
        ('{"effects": [], "parameters": {"Tc": true}}', "parameters.Tc"),
        ('{"effects": [], "parameters": {"Tc": null}}', "parameters.Tc"),
        ('{"effects": [], "parameters": {"Tc": Infinity}}', "parameters.Tc"),
        ('{"effects": [], "parameters": {"Tc": [1]}}', "parameters.Tc"),
    ],
)
def test_a_body_that_makes_no_sense_is_named(client: Client, content: str, parameter: str) -> None:
    response = client.post(MODEL, content=content, headers={"content-type": "application/json"})
    document = problem(response, 422)
    assert document["code"] == "invalid_parameter"
    assert [e["parameter"] for e in document["errors"]] == [parameter], "one complaint of one mistake"


def test_a_body_that_is_no_json_is_told_so(client: Client) -> None:
    """`curl -d` without a header sends a form."""
    form = problem(client.post(MODEL, content='{"effects": []}', headers={"content-type": FORM}), 422)
    assert form["detail"] == "body: a JSON object is needed, sent with Content-Type: application/json"
    cut = problem(client.post(MODEL, content='{"effects": [', headers={"content-type": "application/json"}), 422)
    assert cut["detail"] == "body: not JSON: Expecting value at character 13"


@pytest.mark.parametrize("path", ["/diagnosis", "/diagnosis/report"])
def test_unknown_drives(client: Client, path: str) -> None:
    assert problem(client.get("/api/v1/drives/axis9" + path), 404)["known"] == ["axis1", "axis2"]
    assert problem(client.post("/api/v1/drives/axis9/diagnosis"), 404)["code"] == "unknown_drive"
    assert problem(client.post("/api/v1/drives/axis9/model", json={"effects": []}), 404)["code"] == "unknown_drive"


@pytest.mark.parametrize("path", [DIAGNOSIS, MODEL])
def test_other_sites_may_begin_nothing(daemon: FakeDaemon, client: Client, path: str) -> None:
    headers = {"Origin": "http://evil.example", "content-type": "text/plain"}
    assert problem(client.post(path, content='{"effects": []}', headers=headers), 403)["code"] == "foreign_origin"
    assert daemon.drives["axis1"].asked == [] and daemon.drives["axis1"].diagnosis.diagnosis.status == "idle"


def test_openapi_has_the_problems_and_the_examples(client: Client) -> None:
    document = client.get("/openapi.json").json()
    drive = "/api/v1/drives/{drive}"
    model = document["paths"][f"{drive}/model"]["post"]
    assert set(model["responses"]) == {"200", "202", "403", "404", "409", "422"}
    assert set(document["paths"][f"{drive}/diagnosis"]["post"]["responses"]) == {"202", "403", "404", "409"}
    assert set(document["paths"][f"{drive}/diagnosis"]["get"]["responses"]) == {"200", "404"}
    for status in ("403", "404", "409", "422"):
        assert "application/problem+json" in model["responses"][status]["content"]
    for name in ("DiagnosisDocument", "ModelDocument", "ModelRequestDocument"):
        (example,) = document["components"]["schemas"][name]["examples"]
        getattr(schemas, name).model_validate(example)
