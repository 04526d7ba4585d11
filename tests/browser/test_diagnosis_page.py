"""What the page shows of a diagnosis, and its buttons."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.errors import BusyError
from servo_daemon.published.diagnosis_state import Adoption, Diagnosis, DiagnosisView
from servo_daemon.published.snapshot import Event
from servo_daemon.published.view import ModelChange
from tests.browser.conftest import LiveServer
from tests.browser.devtools import Page
from tests.fake_daemon import RUNNING, T0
from tests.fake_diagnose import document

pytestmark = pytest.mark.system
OpenPage = Callable[..., Page]

FRICTION = ("coulomb_friction",)
FOUND = document("found", 0.0125)
FOUND["effects"][0]["equivalent"] = [["asymmetric_friction"], ["load_dependent_friction", "constant_load_torque"]]
DONE = replace(RUNNING, status="done", finished=T0 + 60, progress=1.0, step=None, result=FOUND)
FAILED = replace(RUNNING, status="failed", finished=T0 + 60, reason="ended after its time limit of 900 s")


def show(server: LiveServer, diagnosis: Diagnosis, adoption: Adoption | None = None, reason: str | None = None) -> None:
    view = DiagnosisView(diagnosis, adoption or Adoption(False), reason is None, reason)
    server.axis1.diagnosis = view
    server.axis1.log.append(Event(time.time(), "diagnosis_done", "as in the daemon, which tells of everything"))


def text(page: Page) -> str:
    return " ".join(page.text("#diagnosis").split())


def test_it_is_begun_and_followed(open_page: OpenPage, server: LiveServer) -> None:
    page = open_page()
    page.until("!document.getElementById('diagnosis').hidden")
    said = text(page)
    assert "not looked at yet" in said and "Adopt" not in said and "Report" not in said
    page.evaluate("document.getElementById('diagnose').click()")
    page.until("document.getElementById('verdict').dataset.verdict == 'running'")
    page.until("document.getElementById('diagnosis-text').textContent == 'round 1: fitting coulomb_friction'")
    assert page.evaluate("document.getElementById('diagnosis-progress').value") == pytest.approx(0.35)
    assert page.evaluate("document.getElementById('diagnose').disabled") is True
    assert page.errors() == []


def test_a_verdict_and_its_adoption(open_page: OpenPage, server: LiveServer) -> None:
    page = open_page()
    show(server, replace(DONE, report=Path("/x")), Adoption(True, FRICTION))
    page.until("document.getElementById('verdict').dataset.verdict == 'found'")
    said = text(page)
    for part in (
        "coulomb friction removes 93.0 % of the error", "bearings and brushes rub", "Tc = 12.50 ± 0.13 mN·m",
        "asymmetric friction or load dependent friction + constant load torque as well",
        "93.0 % of the error is gone (95 %: from 91.0 % to 95.0 %)", "60 s of samples, linear motor:",
    ):  # fmt: skip
        assert part in said, (part, said)
    assert page.evaluate("document.getElementById('report-link').getAttribute('href')") == (
        "api/v1/drives/axis1/diagnosis/report"
    )
    page.evaluate("window.confirm = () => false")
    page.evaluate("document.getElementById('adopt').click()")
    page.evaluate("window.confirm = (question) => (window.asked = question, true)")
    page.evaluate("document.getElementById('adopt').click()")
    page.until("document.getElementById('adopt').textContent == 'Adopting…'")
    assert "linear motor + coulomb friction" in page.evaluate("window.asked")
    assert page.evaluate("document.getElementById('adopt').disabled") is True
    assert server.axis1.was_asked.wait(10)  # the page says "Adopting…" before its request has arrived
    assert server.axis1.asked == [(FRICTION, {})]
    assert page.errors() == []


def test_what_is_adopted_is_forgotten(open_page: OpenPage, server: LiveServer) -> None:
    rest = {"budget_s": 900.0, "cpu_s": 903.1, "not_tried": ["coulomb_friction + backlash"]}
    show(server, replace(DONE, result={**FOUND, "unfinished": rest}), Adoption(True, FRICTION))
    page = open_page()
    page.until("document.getElementById('verdict').dataset.verdict == 'found'")
    assert "within 900 s of processor time: not tried is coulomb friction + backlash" in text(page)
    assert "another request goes on" in text(page)
    show(server, DONE, Adoption(False, FRICTION, "the drive has this model"))
    server.paused.add("axis1")
    live = server.axis1.snapshot()
    assert live.estimate is not None
    server.axis1.publish(replace(live, estimate=replace(live.estimate, model=FRICTION)))
    page.until("document.getElementById('verdict').dataset.verdict == 'adopted'")
    assert "coulomb friction was found, and is part of the model now" in text(page)
    assert page.evaluate("document.getElementById('found').children.length") == 0
    assert page.evaluate("document.getElementById('adopt').hidden && document.getElementById('unfinished').hidden")
    assert "Nothing to adopt" not in text(page)
    assert page.errors() == []


def test_a_refusal_is_shown(open_page: OpenPage, server: LiveServer) -> None:
    page = open_page()
    show(server, DONE, Adoption(True, FRICTION))
    server.axis1.refusal = BusyError("another change of this drive's model is under way")
    page.until("!document.getElementById('adopt').hidden")
    page.evaluate("window.confirm = () => true")
    page.evaluate("document.getElementById('adopt').click()")
    page.until("document.getElementById('diagnosis-why').textContent.includes('under way')")
    page.until("!document.getElementById('adopt').disabled")
    server.axis1.refusal, server.axis1.outcome = None, ModelChange(FRICTION, T0)
    page.evaluate("document.getElementById('adopt').click()")
    page.until("!document.getElementById('diagnosis-why').textContent.includes('under way')")


@pytest.mark.parametrize(
    ("diagnosis", "adoption", "reason", "badge", "said"),
    [
        (FAILED, Adoption(False), None, "failed", "ended after its time limit of 900 s"),
        (replace(DONE, result=document("none", 0.0)), Adoption(False), None, "none", "explains the data to its noise"),
        (replace(DONE, result=document("unexplained", 0.0)), Adoption(False), None, "unexplained", "it follows speed"),
        (
            DONE, Adoption(False, FRICTION, "the configuration says adopt = \"never\""), None, "found",
            'Nothing to adopt: the configuration says adopt = "never".',
        ),
        (Diagnosis(), Adoption(False), "3.2 s of samples are there, 10 s are needed", "idle", "3.2 s of samples are"),
    ],
    ids=["failed", "none", "unexplained", "never", "too few"],
)  # fmt: skip
def test_what_is_not_possible_says_why(
    open_page: OpenPage, server: LiveServer, diagnosis: Diagnosis, adoption: Adoption, reason: str | None, badge: str,
    said: str,
) -> None:  # fmt: skip
    show(server, diagnosis, adoption, reason)
    page = open_page()
    page.until(f"document.getElementById('verdict').dataset.verdict == '{badge}'")
    assert said in text(page)
    assert page.evaluate("document.getElementById('diagnose').disabled") is (reason is not None)
    hidden, disabled = "document.getElementById('adopt').hidden", "document.getElementById('adopt').disabled"
    assert page.evaluate(f"{hidden} || {disabled}") is True
    assert page.errors() == []


def test_another_drive_has_its_own(open_page: OpenPage, server: LiveServer) -> None:
    show(server, DONE, Adoption(True, FRICTION))
    page = open_page()
    page.until("document.getElementById('verdict').dataset.verdict == 'found'")
    page.evaluate("location.hash = '#axis2'")
    page.until("document.getElementById('verdict').dataset.verdict == 'idle'")
    assert page.evaluate("document.getElementById('found').children.length") == 0
    page.evaluate("document.getElementById('diagnose').click()")
    page.until("document.getElementById('verdict').dataset.verdict == 'running'")
    assert server.daemon.drives["axis2"].diagnosis.diagnosis.status == "running"
    assert server.axis1.diagnosis.diagnosis.status == "done", "the buttons are of one drive only"


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (320, True)])
def test_it_fits(open_page: OpenPage, server: LiveServer, width: int, dark: bool, tmp_path: Path) -> None:
    long: dict[str, Any] = {**FOUND, "effects": FOUND["effects"] * 3}
    reason = "a diagnosis of drive a_name_that_is_as_long_as_names_may_be is running; there is one at a time"
    show(server, replace(DONE, result=long, report=Path("/x")), Adoption(True, FRICTION), reason)
    page = open_page(width, dark=dark)
    page.until("document.getElementById('verdict').dataset.verdict == 'found'")
    assert page.evaluate("document.documentElement.scrollWidth") == width
    page.picture(tmp_path / "page.png")
    assert page.errors() == []
