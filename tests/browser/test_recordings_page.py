"""Samples on the page: the scope, recordings, and the events that they belong to; full screen and moving in time."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.errors import BusyError
from servo_daemon.published.archive import KeptCapture
from servo_daemon.published.snapshot import Event
from servo_daemon.samples import make_block
from tests.browser.conftest import LiveServer
from tests.browser.devtools import TIMEOUT_S, Browser, Page
from tests.browser.test_windows_page import CHART, WHERE
from tests.fake_daemon import FakeCaptures

pytestmark = pytest.mark.system
OpenPage = Callable[..., Page]

PLOTS = "[...document.querySelectorAll('#scope-plots .u-title')].map((title) => title.textContent)"
NOTE = "document.getElementById('scope-note').textContent"
SET = """(() => {
  const { elements } = document.getElementById('scope-form');
  Object.entries(%s).forEach(([name, value]) => (elements[name].value = value));
  elements.trigger.dispatchEvent(new Event('change', {bubbles: true}));
})()"""


@pytest.fixture
def captures(server: LiveServer, tmp_path: Path) -> FakeCaptures:
    path = tmp_path / "20261121T120000000Z-60000ms-alarm.parquet"
    path.write_bytes(b"samples")
    now = time.time()
    made = FakeCaptures([KeptCapture("20261121T120000000Z-60000ms-alarm", "axis1", "alarm", now - 30, now, 7, path)])
    server.daemon.captures = made
    server.stop_serving()
    server.serve()
    return made


def test_a_snapshot_about_a_trigger(open_page: OpenPage, server: LiveServer) -> None:
    for k in range(30):
        t = k / 10 + np.arange(100) / 1000
        wave = np.sin(2 * np.pi * t)
        server.axis1.ring.append(make_block(t, voltage_V=10 * wave, current_A=wave))
    page = open_page()
    page.until("document.querySelectorAll('#scope-form [name=trigger] option').length == 3")
    assert page.evaluate("document.querySelector('#scope-form [name=level]').disabled") is True
    page.evaluate(SET % "{trigger: 'current_A', level: '0.5', seconds: '0.5'}")
    assert page.text("#scope-unit") == "A"
    page.evaluate("document.getElementById('scope-form').requestSubmit()")
    page.until(
        "document.getElementById('scope-note').textContent.startsWith('501 samples at 1000 Hz; ms from the trigger')"
    )
    assert page.evaluate(PLOTS) == ["Voltage, V", "Current, A"]
    page.evaluate(SET % "{level: '3'}")
    page.evaluate("document.getElementById('scope-run').click()")
    page.until(NOTE + " == 'No such crossing in the last ten seconds.'")
    assert page.text("#scope-run") == "Stop"
    page.evaluate(SET % "{level: '-0.5', edge: 'falling'}")
    page.until(NOTE + ".includes('trigger')")
    page.evaluate("document.getElementById('scope-run').click()")
    assert page.text("#scope-run") == "Run"
    assert page.errors() == []


def test_a_recording_is_asked_for_and_fetched(open_page: OpenPage, server: LiveServer, captures: FakeCaptures) -> None:
    server.axis1.log.append(Event(time.time() - 15, "alarm", "R is above its limit"))
    server.axis1.log.append(Event(time.time() - 99, "connected", "before the recording"))
    page = open_page()
    page.until("document.querySelectorAll('#events a').length == 1")
    href = page.evaluate("document.querySelector('#events a').getAttribute('href')")
    assert href == "api/v1/drives/axis1/captures/20261121T120000000Z-60000ms-alarm"
    assert page.evaluate(f"fetch({href!r}).then((answer) => answer.text())") == "samples"
    page.evaluate("document.getElementById('record').click()")
    page.until("document.querySelector('#record-note a')?.download.startsWith('axis1-2026')")
    assert captures.asked == [60]
    captures.refusal = BusyError("no samples are there")
    page.evaluate("document.getElementById('record').click()")
    page.until("document.getElementById('record-note').textContent == 'Not recorded: No samples are there.'")


def test_the_curves_are_saved_as_a_table(open_page: OpenPage, browser: Browser, tmp_path: Path) -> None:
    page = open_page()
    browser.command("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    page.evaluate("document.getElementById('download').click()")
    deadline = time.monotonic() + TIMEOUT_S
    while not (tmp_path / "axis1.csv").exists():
        assert time.monotonic() < deadline, page.text("#record-note")
        time.sleep(0.02)
    table = (tmp_path / "axis1.csv").read_text(encoding="utf-8").splitlines()
    assert table[0].startswith("time,R,R_std,R_status,") and "current_A" in table[0] and len(table) > 100


def test_where_none_are_kept_the_page_says_how_they_could_be(open_page: OpenPage) -> None:
    page = open_page()
    page.until("document.getElementById('record-note').textContent.includes('captures_quota_MB')")
    assert page.evaluate("document.getElementById('record').disabled") is True


def test_a_mark_on_the_curves_opens_its_event(open_page: OpenPage, server: LiveServer) -> None:
    when = time.time() - 20
    server.axis1.log.append(Event(when, "alarm", "R is above its limit"))
    page = open_page()
    page.until("document.querySelectorAll('#events li').length == 1")
    page.until((CHART % "R") + f".then(([from, to]) => from < {when})")
    begin, end, _ = page.evaluate(CHART % "R")
    x, y, width = page.evaluate(WHERE)
    page.click(x + width * (when - begin) / (end - begin), y + 60)
    page.until("document.activeElement.id?.startsWith('event-alarm-')")
    assert page.errors() == []


def test_full_screen_and_back(open_page: OpenPage) -> None:
    page = open_page()
    button = "document.querySelector('[data-name=R] .full')"
    assert page.evaluate(button + ".getAttribute('aria-label')") == "R resistance in full screen"
    page.evaluate(button + ".click()")
    page.until("document.fullscreenElement?.dataset.name == 'R'")
    page.until("document.querySelector('[data-name=R] canvas').clientHeight > 400")
    page.evaluate(button + ".click()")
    page.until("document.querySelector('[data-name=R] canvas').clientHeight == 150")


def test_buttons_move_in_time(open_page: OpenPage) -> None:
    page = open_page()
    page.until((CHART % "R") + ".then(([from, to]) => to - from > 30)")
    begin, end, _ = page.evaluate(CHART % "R")

    def move(how: str) -> None:
        page.evaluate(f"document.querySelector('[data-move={how}]').click()")

    move("in")
    page.until((CHART % "R") + f".then(([from, to]) => to - from < {0.7 * (end - begin)})")
    move("back")
    page.until((CHART % "J") + f".then(([from]) => from < {begin + 5})")
    move("out")
    page.until((CHART % "R") + f".then(([from, to]) => to - from > {0.9 * (end - begin)})")
    for _ in range(3):
        move("on")
    page.until("document.getElementById('zoomed').hidden")
    assert page.errors() == []
