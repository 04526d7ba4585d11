"""Windows of time, the labels of the time axis, and zooming."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.browser.conftest import LiveServer
from tests.browser.devtools import Page
from tests.fake_daemon import live_snapshot

pytestmark = pytest.mark.system
OpenPage = Callable[..., Page]

CHART = """import('/assets/chart.js').then(({charts}) => {
  const element = document.querySelector('[data-name=%s] .chart');
  const { plot } = [...charts].find((c) => c.element === element);
  return [plot.scales.x.min, plot.scales.x.max, plot.axes[0]._values];
})"""
TICKS = "import('/assets/times.js').then(({tickText}) => tickText(%s))"
WHERE = """(() => {
  const r = document.querySelector('[data-name=R] .u-over').getBoundingClientRect();
  return [r.x, r.y, r.width];
})()"""


#: The least number of labels on a chart's time axis while it moves on by its own length.
LABELS = """import('/assets/chart.js').then(({charts}) => {
  const { plot } = [...charts][0];
  let least = Infinity;
  for (let k = 0; k < 30; k++) {
    const min = 1795262400 + k * %(s)d / 30;
    plot.batch(() => plot.setScale('x', { min, max: min + %(s)d }));
    least = Math.min(least, plot.axes[0]._values.filter((text) => text).length);
  }
  return least;
})"""


def choose(page: Page, seconds: int) -> None:
    page.evaluate(
        f"(() => {{ const w = document.getElementById('window'); w.value = '{seconds}';"
        " w.dispatchEvent(new Event('change')); })()"
    )


def test_a_year_is_asked_for_and_what_there_is_of_it_shown(open_page: OpenPage, server: LiveServer) -> None:
    ring = type(server.axis1.history)()
    for k in range(200):  # three days, up to now
        ring.append(live_snapshot("axis1", server.started - 3e5, server.started - 1296.0 * (200 - k)))
    server.axis1.history = ring
    page = open_page()
    server.asked.clear()
    choose(page, 31_557_600)
    page.until("document.querySelectorAll('#parameters .uplot').length == 5")
    page.until((CHART % "R") + ".then(([from, to]) => to - from > 2.9 * 86400)")
    labels = [text for text in page.until(CHART % "R")[2] if text]
    assert len(labels) >= 2 and all("-" in text for text in labels), "dates"
    assert any("/history?parameter=R&window=31557600s&points=" in path for path in server.asked)
    assert page.errors() == []


def test_labels_of_the_time_axis(open_page: OpenPage) -> None:
    page = open_page()
    for seconds in (60, 300, 1800, 21_600, 86_400, 604_800, 2_592_000, 31_557_600):
        assert page.evaluate(LABELS % {"s": seconds}) >= 1, f"{seconds} s: labels vanish"
    noon = page.evaluate("new Date().setHours(12, 0, 0, 0) / 1000")
    for call, text in (
        (f"{noon}, 30, {noon} - 100, {noon}", "12:00:00"),
        (f"{noon}, 60, {noon} - 300, {noon}", "12:00"),
    ):
        assert page.evaluate(TICKS % call) == text
    day = page.evaluate("new Date(2026, 2, 9, 14, 30).getTime() / 1000")
    assert page.evaluate(TICKS % f"{day}, 3600, {day} - 86400, {day}") == "03-09 14:30"
    assert page.evaluate(TICKS % f"{day}, 86400, {day} - 864000, {day}") == "2026-03-09"
    assert page.evaluate(TICKS % f"{day}, 2678400, {day} - 3e7, {day}") == "2026-03"


def test_a_span_is_drawn_up_and_reset(open_page: OpenPage, server: LiveServer) -> None:
    page = open_page()
    page.until((CHART % "R") + ".then(([from, to, texts]) => to - from > 30 && texts.some((t) => t))")
    x, y, width = page.evaluate(WHERE)
    server.asked.clear()
    page.drag(x + 0.25 * width, y + 40, x + 0.5 * width)
    page.until("!document.getElementById('zoomed').hidden")
    page.until((CHART % "current_A") + ".then(([from, to]) => to - from < 20)")
    (one, two), (three, four) = page.evaluate(CHART % "R")[:2], page.evaluate(CHART % "J")[:2]
    assert (one, two) == (three, four) and 5 < two - one < 20
    assert sum("/history?" in path and "&end=" in path for path in server.asked) == 8, "each series once"
    page.press("Escape", 27)
    page.until("document.getElementById('zoomed').hidden")
    page.until((CHART % "R") + f".then(([from, to]) => to > {two + 1})")
    assert page.errors() == []
