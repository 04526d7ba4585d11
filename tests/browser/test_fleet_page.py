"""All drives at a glance."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.browser.conftest import LiveServer
from tests.browser.devtools import Browser, Page
from tests.browser.test_alarm_page import R_MAX, ring
from tests.fake_daemon import fake_daemon

pytestmark = pytest.mark.system
TO_DO = """import('/assets/fleet.js').then(({toDo}) => toDo({
  connection: 'connected', alarms: [], statuses: {tracking: 5}, model: [], worst: null,
  diagnosis: {verdict: null, effects: []}, ...%s,
}))"""
#: When the curve of a history is asked for again, ms from now: the age of its last bucket of an hour, ms, or none.
DUE = """import('/assets/sparkline.js').then(({due}) =>
  due({time: %s.map((age) => new Date(Date.now() - age).toISOString()), period_s: 3600}, []) - Date.now())"""
ROW = "document.getElementById('fleet-rows').rows[%d]"


@contextmanager
def open_fleet(browser: Browser, server: LiveServer, *, dark: bool = False) -> Iterator[Page]:
    """The view of all drives."""
    page = Page(browser)
    try:
        page.look(1280, 900, dark=dark)
        page.open(server.address + "/")
        page.until("document.getElementById('fleet-rows').rows.length == 2")
        yield page
    finally:
        page.close()


@pytest.fixture
def fleet(browser: Browser, server: LiveServer) -> Iterator[Page]:
    with open_fleet(browser, server) as page:
        yield page


def row(page: Page, k: int) -> str:
    return " ".join(str(page.evaluate((ROW % k) + ".innerText")).split())


def test_one_row_a_drive_and_a_click_opens_it(fleet: Page, server: LiveServer) -> None:
    assert row(fleet, 0).startswith("axis1 simulated connected 5 of 5 known K: +53.")
    assert row(fleet, 0).endswith("none nothing")
    assert fleet.text("#connection") == "2 of 2 connected"
    curve = "document.querySelector('#fleet-rows .spark')"
    fleet.until(curve + " !== null")
    said = str(fleet.evaluate(curve + ".getAttribute('aria-label')"))
    assert re.fullmatch(r"K over the last 30 days: from 0\.3\d+ to 0\.3\d+, [+−±]\d\.\d\d %", said), said
    heights = fleet.evaluate(curve + ".firstChild.getAttribute('points')").split()
    assert 20 < len(heights) <= 60 and all(0 <= float(p.split(",")[1]) <= 24 for p in heights)
    assert fleet.evaluate("document.querySelectorAll('.uplot').length") == 0
    fleet.evaluate((ROW % 1) + ".cells[3].click()")
    fleet.until("document.querySelectorAll('#parameters .card').length == 5")
    assert fleet.evaluate("document.title") == "axis2 · servo-daemon"
    assert fleet.evaluate("document.getElementById('fleet').hidden") is True
    fleet.evaluate("history.back()")
    fleet.until("!document.getElementById('fleet').hidden && document.querySelectorAll('.card').length == 0")
    assert fleet.evaluate("document.getElementById('drive').value") == ""
    assert fleet.errors() == []


@pytest.mark.parametrize(("ages", "wait_s"), [("[]", 20), ("[3.6e6]", 20), ("[3.5e6]", 100), ("[60e3]", 600)])
def test_a_curve_is_asked_for_again_when_it_can_be_longer(fleet: Page, ages: str, wait_s: float) -> None:
    assert fleet.evaluate(DUE % ages) == pytest.approx(1000 * wait_s, abs=1000)


def test_what_is_to_be_done(fleet: Page, server: LiveServer) -> None:
    server.paused |= {"axis1", "axis2"}
    server.axis1.limits = (R_MAX,)
    ring(server, "R_max")
    server.daemon.drives["axis2"].lose("down", "/dev/ttyUSB0 is gone")
    fleet.until((ROW % 0) + ".classList.contains('alarm')")
    assert "R: alarm R_max" in row(fleet, 0) and row(fleet, 0).endswith("R_max Inspect what R depends on")
    fleet.until((ROW % 1) + ".innerText.includes('Check supply and line: /dev/ttyUSB0 is gone')")
    for changes, said in (
        ("{}", None),
        ("{statuses: {tracking: 4, estimating: 1}}", "Let it move: not all parameters are known yet"),
        (
            "{diagnosis: {verdict: 'found', effects: ['dry_friction']}}",
            "Decide about dry friction: found by the diagnosis",
        ),
        ("{diagnosis: {verdict: 'found', effects: ['dry_friction']}, model: ['dry_friction']}", None),
        (
            "{connection: 'connecting', reason: 'no such port; next attempt in 5 s'}",
            "Check supply and line: no such port; next attempt in 5 s",
        ),
        ("{alarms: ['controller_margin']}", "Tune again: the controller's margins are too small"),
        ("{statuses: {at_bound: 1}, worst: {parameter: 'J', why: 'at its bound'}}", "See why J cannot be told"),
    ):
        assert fleet.evaluate(TO_DO % changes) == said
    server.daemon.wrong = tuple(f"drive axis{k}: the pipeline has not turned for 9 s" for k in range(9))
    fleet.until("document.getElementById('fleet-problems').innerText.split('\\n').length == 5")
    assert fleet.text("#fleet-problems").endswith("for 9 s\nand 5 more: /api/v1/health")
    fleet.look(390, 900, dark=True)
    assert fleet.evaluate("document.documentElement.scrollWidth") == 390
    assert server.asked.count("/api/v1/drives") == 1, "the table has all that the list has"
    assert fleet.errors() == []


def test_the_picker_follows_drives_that_come_and_go(fleet: Page, server: LiveServer) -> None:
    fleet.evaluate((ROW % 1) + ".cells[3].click()")
    fleet.until("document.title == 'axis2 · servo-daemon'")
    two = server.daemon.drives
    server.daemon.drives = {**two, **fake_daemon("axis3").drives}
    fleet.until("document.getElementById('drive').length == 4", 30)
    assert fleet.evaluate("document.getElementById('drive').value") == "axis2", "the choice stays"
    server.daemon.drives = {"axis1": two["axis1"]}
    fleet.until("document.title == 'axis1 · servo-daemon'", 30)
    assert fleet.evaluate("document.getElementById('drive').value") == "axis1"
