"""axe-core finds nothing on the page that keeps anybody from using it."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servo_daemon.published.diagnosis_state import Adoption
from servo_daemon.published.snapshot import Event
from servo_daemon.samples import make_block
from tests.browser.conftest import LiveServer
from tests.browser.devtools import Browser, Page
from tests.browser.test_alarm_page import R_MAX, ring
from tests.browser.test_diagnosis_page import DONE, FRICTION, show
from tests.browser.test_fleet_page import open_fleet
from tests.fake_daemon import live_snapshot

pytestmark = pytest.mark.system
OpenPage = Callable[..., Page]
AXE = Path(__file__).parent / "axe" / "axe.min.js"
FOUND = """axe.run(document).then(({violations}) => violations.map(({id, help, nodes}) =>
  [id, help, nodes.map(({html, failureSummary}) => [html.slice(0, 200), failureSummary])]))"""


def violations(page: Page) -> Any:
    page.evaluate(AXE.read_text(encoding="utf-8") + "; undefined")
    return page.evaluate(FOUND)


def test_axe_is_what_its_note_says() -> None:
    note = (AXE.parent / "VENDORED.md").read_text(encoding="utf-8")
    assert (
        f"{hashlib.sha256(AXE.read_bytes()).hexdigest()}  {AXE.name}" in note and "Mozilla Public License 2.0" in note
    )


@pytest.fixture
def everything_wrong(server: LiveServer) -> LiveServer:
    """An alarm, a finding, an estimate that has just begun and a drive that is away: each has colours of its own."""
    server.axis1.limits = (R_MAX,)
    server.paused |= {"axis1", "axis2"}
    live = live_snapshot("axis1", server.started)
    assert live.estimate is not None
    first, second, *rest = live.estimate.parameters
    begun = (first, replace(second, status="estimating", std=None, reason="too little motion"), *rest)
    server.axis1.publish(replace(live, estimate=replace(live.estimate, parameters=begun)))
    server.daemon.drives["axis2"].lose("down", "/dev/ttyUSB0 is gone")
    server.daemon.wrong = ("drive axis1: its state cannot be saved",)
    server.axis1.log.append(Event(time.time(), "alarm", "R is above its limit", {"alarm": "R_max"}))
    ring(server, "R_max")
    server.axis1.ring.append(make_block(np.arange(100) / 1000, voltage_V=np.ones(100), current_A=np.ones(100)))
    show(server, replace(DONE, report=Path("/x")), Adoption(True, FRICTION))
    return server


@pytest.mark.parametrize("dark", [False, True])
def test_no_violations(everything_wrong: LiveServer, browser: Browser, open_page: OpenPage, dark: bool) -> None:
    page = open_page(dark=dark)
    page.until("document.getElementById('verdict').dataset.verdict == 'found'")
    page.until("!document.getElementById('alarms').hidden")
    page.until("/^servo-daemon [0-9]/.test(document.getElementById('version').textContent)")
    page.evaluate("document.getElementById('scope-form').requestSubmit()")
    page.until("!document.getElementById('scope-plots').hidden")
    assert violations(page) == []
    page.evaluate("location.hash = '#axis2'")
    page.until("document.getElementById('connection').dataset.state == 'down'")
    assert violations(page) == []
    with open_fleet(browser, everything_wrong, dark=dark) as fleet:
        fleet.until("!document.getElementById('fleet-problems').hidden")
        assert violations(fleet) == []
