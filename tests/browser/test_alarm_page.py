"""What the page shows of alarms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from servo_daemon.published.snapshot import AlarmLimit, Event
from tests.browser.conftest import LiveServer
from tests.browser.devtools import Page
from tests.fake_daemon import TRUE, live_snapshot

pytestmark = pytest.mark.system
OpenPage = Callable[..., Page]

R_MAX = AlarmLimit("R_max", "R", True, 0.9 * TRUE["R"])
K_MIN = AlarmLimit("K_min", "K", False, 0.2 * TRUE["K"])
WORDS = "R = 0.494 Ω is above its limit R_max = 0.444 Ω"
#: Names of the lines in a card's chart, and the ends of its scale.
DRAWN = """import('/assets/chart.js').then(({charts}) => {
  const element = document.querySelector('[data-name=%s] .chart');
  const chart = [...charts].find((c) => c.element === element);
  return [chart.lines.map((l) => [l.name, l.value]), chart.plot.scales.y.min, chart.plot.scales.y.max];
})"""


def ring(server: LiveServer, names: str | None) -> None:
    live = live_snapshot("axis1", server.started)
    assert live.estimate is not None
    health = {**live.estimate.health, "alarms": names}
    server.axis1.publish(replace(live, estimate=replace(live.estimate, health=health)))


def test_a_ringing_alarm_is_seen_and_ends(open_page: OpenPage, server: LiveServer) -> None:
    server.axis1.limits = (R_MAX, K_MIN)
    page = open_page()
    server.paused.add("axis1")
    server.axis1.log.append(Event(server.started, "alarm", WORDS, {"alarm": "R_max", "parameter": "R"}))
    ring(server, "R_max,controller_margin")
    page.until(f"document.getElementById('alarms').textContent.includes({WORDS!r})")
    assert "controller margin is too low" in page.text("#alarms")
    page.until("document.querySelector('[data-name=R] .badge').textContent == '▲ alarm R_max'")
    assert page.evaluate("document.querySelectorAll('.card.alarm').length") == 1
    red = page.evaluate("getComputedStyle(document.querySelector('[data-name=R] .badge')).color")
    assert red == page.evaluate("getComputedStyle(document.getElementById('alarms')).color")
    lines, low, high = page.evaluate(DRAWN % "R")
    assert ["R_max", R_MAX.value] in lines and low < R_MAX.value < high
    lines, low, _ = page.evaluate(DRAWN % "K")
    assert ["K_min", K_MIN.value] in lines and low > K_MIN.value, "far away and silent: an arrow"
    assert page.evaluate("document.getElementById('limit-key').hidden") is False
    ring(server, None)
    page.until("document.getElementById('alarms').hidden")
    page.until("document.querySelector('[data-name=R] .badge').textContent == '● tracking'")
    assert page.errors() == []
