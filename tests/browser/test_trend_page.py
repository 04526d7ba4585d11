"""The trend card, and how sure the page says it is of what it shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from servo_daemon.published.trends import DriveTrends
from servo_daemon.trend.records import Limit, Range, Trend
from tests.browser.conftest import LiveServer
from tests.browser.devtools import Page
from tests.fake_daemon import T0, live_snapshot, parameters_at

pytestmark = pytest.mark.system
OpenPage = Callable[..., Page]

AGEING = Trend(
    "trend", rate_percent=Range(1.2, 1.8, 2.5), limit=Limit("R_max", 0.7, True), years=Range(0.1, 0.2, 0.3),
    used=Range(0.6, 0.7, 0.8), remark="no temperature is known",
)  # fmt: skip


def test_trends_are_told_in_words(open_page: OpenPage, server: LiveServer) -> None:
    short = Trend("too_short", "3 days are there")
    trends = {"L": Trend("no_trend"), "R": AGEING, "K": short, "J": Trend("no_trend"), "B": Trend("no_trend")}
    server.axis1.trends = DriveTrends(T0, None, trends=trends, near=frozenset({"R"}))
    page = open_page()
    page.until("document.querySelectorAll('#trends li').length == 3")
    first = page.text("#trends li.near")
    assert first.startswith("R +1.8 %/year (1.2–2.5); R_max in 1") and "no temperature is known" in first
    assert page.text("#trends li:nth-child(2)") == "L, J, B: no trend"
    assert "3 days are there" in page.text("#trends")
    page.evaluate("location.hash = '#axis2'")
    page.until("document.getElementById('trend-why').textContent.includes('a minute after the start')")
    assert page.evaluate("document.querySelectorAll('#trends li').length") == 0
    assert page.errors() == []


def test_what_is_not_known_yet_is_grey_and_what_is_simulated_says_so(open_page: OpenPage, server: LiveServer) -> None:
    server.paused |= {"axis1", "axis2"}
    live = live_snapshot("axis1", server.started)
    assert live.estimate is not None
    first, *others = parameters_at(1.0)
    unknown = replace(first, status="estimating", reason="no motion yet")
    server.axis1.publish(replace(live, estimate=replace(live.estimate, parameters=(unknown, *others))))
    page = open_page()
    colour = "getComputedStyle(document.querySelector('[data-name=%s] .number')).color"
    page.until("document.querySelector('[data-name=R]').dataset.status == 'estimating'")
    muted = "getComputedStyle(document.querySelector('[data-name=R] .compare')).color"
    assert page.evaluate(colour % "R") == page.evaluate(muted) != page.evaluate(colour % "L")
    assert "SIMULATED" in page.text("#simulated") and "95 % band" in page.text(".legend")
    server.daemon.drives["axis2"].publish(replace(live_snapshot("axis2", server.started), truth=None))
    page.evaluate("location.hash = '#axis2'")
    page.until("document.getElementById('simulated').hidden")
    assert page.errors() == []
