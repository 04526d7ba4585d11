"""A report in a real browser: from a file, and as the daemon would serve it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from servo_daemon.api.access.guard import Guard
from servo_daemon.report import (
    Axis,
    Iterations,
    Line,
    Mark,
    Points,
    Scatter,
    Section,
    Spectrum,
    TimeSeries,
    content_security_policy,
    render_report,
    write_report,
)
from tests.browser.devtools import Browser, Page
from tests.http_rig import serving
from tests.report_demo import SPIKE_S, demo_report

pytestmark = pytest.mark.system
OpenReport = Callable[..., Page]

CURRENT, SPEED, TORQUE, SCATTER, SPECTRUM, COST = "f1", "f2", "f4", "f5", "f6", "f7"
DRAWN = "document.documentElement.classList.contains('drawn')"

#: How many pixels of a figure's canvas have the colour that the style sheet gives a name.
INKED = """(() => {
  const canvas = document.querySelector('#%s canvas');
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d', {willReadFrequently: true});
  copy.drawImage(canvas, 0, 0);
  const data = copy.getImageData(0, 0, canvas.width, canvas.height).data;
  const probe = document.createElement('i');
  probe.className = '%s';
  document.body.append(probe);
  const [r, g, b] = getComputedStyle(probe).color.match(/\\d+/g).map(Number);
  probe.remove();
  let inked = 0;
  for (let k = 0; k < data.length; k += 4)
    if (Math.abs(data[k] - r) + Math.abs(data[k + 1] - g) + Math.abs(data[k + 2] - b) < 12) inked++;
  return inked;
})()"""


@pytest.fixture(scope="module")
def report_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report <1> & 100 %.html"
    write_report(path, demo_report())
    return path


@pytest.fixture
def open_report(browser: Browser, report_file: Path) -> Iterator[OpenReport]:
    """`open_report(width=1280, dark=False, url=None)`: the report, its figures drawn. Closed at the end."""
    pages = []

    def opened(width: int = 1280, url: str | None = None, **look: Any) -> Page:
        page = Page(browser)
        pages.append(page)
        page.look(width, 900, **look)
        page.open(url or report_file.as_uri())
        page.until(DRAWN)
        return page

    yield opened
    for page in pages:
        page.close()


def shown(page: Page, figure: str, axis: str = "x") -> tuple[float, float]:
    """What is visible of one of a figure's axes."""
    low, high = page.evaluate(f"document.getElementById('{figure}').dataset.{axis}").split()
    return float(low), float(high)


def over(page: Page, figure: str) -> dict[str, float]:
    """Where the figure's plotting area is in the window, scrolled to its middle."""
    element = f"document.querySelector('#{figure} .u-over')"
    page.evaluate(f"{element}.scrollIntoView({{block: 'center'}})")
    return dict(page.evaluate(f"{element}.getBoundingClientRect().toJSON()"))


def mouse(page: Page, kind: str, x: float, y: float, clicks: int = 1) -> None:
    button = {"button": "left", "buttons": 1, "clickCount": clicks}
    page.command("Input.dispatchMouseEvent", {"type": kind, "x": x, "y": y, **button})


def drag(page: Page, figure: str, start: float, stop: float) -> None:
    """From one part of the width to another."""
    box = over(page, figure)
    y = box["y"] + box["height"] / 2
    left, right = (box["x"] + part * box["width"] for part in (start, stop))
    page.command("Input.dispatchMouseEvent", {"type": "mouseMoved", "x": left, "y": y})
    mouse(page, "mousePressed", left, y)
    mouse(page, "mouseMoved", (left + right) / 2, y)
    mouse(page, "mouseMoved", right, y)
    mouse(page, "mouseReleased", right, y)


@pytest.mark.first_is_fast
@pytest.mark.parametrize("dark", [False, True])
def test_every_figure_is_drawn_from_a_file(open_report: OpenReport, dark: bool, tmp_path: Path) -> None:
    page = open_report(dark=dark)
    assert page.evaluate("location.protocol") == "file:"
    for figure in (CURRENT, SPEED, "f3", TORQUE, SPECTRUM, COST):
        assert page.evaluate(INKED % (figure, "c1")) > 200, figure
    for figure in (CURRENT, TORQUE, SCATTER, SPECTRUM, COST):
        assert page.evaluate(INKED % (figure, "c2")) > 200, figure
    assert page.evaluate("document.querySelectorAll('math').length") == 2
    assert page.evaluate("document.querySelector('.bars .bar').getBoundingClientRect().width") > 100
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", ground))) < 150) == dark
    assert page.evaluate("document.images.length") == 0, "text became markup"
    page.picture(tmp_path / "report.png")
    assert page.errors() == []


def test_dragging_zooms_the_figures_of_a_group_and_a_double_click_goes_back(open_report: OpenReport) -> None:
    page = open_report()
    whole, frequencies = shown(page, CURRENT), shown(page, SPECTRUM)
    assert whole == (0, pytest.approx(59.999))
    drag(page, CURRENT, 0.25, 0.5)
    assert shown(page, CURRENT) == pytest.approx((15, 30), abs=0.2)
    assert shown(page, SPEED) == shown(page, TORQUE) == shown(page, CURRENT)
    assert shown(page, SPECTRUM) == frequencies
    drag(page, TORQUE, 0.5, 0.75)
    assert shown(page, CURRENT) == pytest.approx((22.5, 26.25), abs=0.2)
    box = over(page, CURRENT)
    for clicks in (1, 2):
        mouse(page, "mousePressed", box["x"] + 100, box["y"] + 100, clicks)
        mouse(page, "mouseReleased", box["x"] + 100, box["y"] + 100, clicks)
    assert shown(page, CURRENT) == shown(page, TORQUE) == whole
    assert page.errors() == []


def test_a_scatter_zooms_by_itself_in_both_directions(open_report: OpenReport) -> None:
    page = open_report()
    before, others = shown(page, SCATTER), shown(page, CURRENT)
    height = shown(page, SCATTER, "y")
    drag(page, SCATTER, 0.45, 0.55)
    low, high = shown(page, SCATTER)
    assert high - low == pytest.approx(0.1 * (before[1] - before[0]), rel=0.1)
    assert shown(page, CURRENT) == others
    page.evaluate(f"document.querySelector('#{SCATTER} [data-zoom=whole]').click()")
    assert (shown(page, SCATTER), shown(page, SCATTER, "y")) == (before, height)
    page.evaluate(f"document.querySelector('#{SCATTER} [data-zoom=in]').click()")
    for axis, (low, high) in (("x", before), ("y", height)):
        now = shown(page, SCATTER, axis)
        assert now[1] - now[0] == pytest.approx((high - low) / 2, rel=0.02), axis
    page.evaluate(f"document.querySelector('#{SCATTER} [data-zoom=whole]').click()")
    assert (shown(page, SCATTER), shown(page, SCATTER, "y")) == (before, height)
    assert page.evaluate(INKED % (SCATTER, "c2")) > 200
    assert page.errors() == []


def test_zoom_without_a_mouse(open_report: OpenReport) -> None:
    page = open_report()
    whole = shown(page, CURRENT)
    page.evaluate(f"document.querySelector('#{CURRENT} .canvas').focus()")
    for key, expected in (
        ("+", (15, 45)),
        ("+", (22.5, 37.5)),
        ("ArrowRight", (26.25, 41.25)),
        ("-", (18.75, 48.75)),
        ("ArrowLeft", (11.25, 41.25)),
    ):
        page.press(key, 0)
        assert shown(page, CURRENT) == pytest.approx(expected, abs=0.1), key
    for _ in range(4):
        page.press("ArrowLeft", 0)
    assert shown(page, CURRENT) == pytest.approx((0, 30), abs=0.2), "it stops at the end of the data"
    page.press("Escape", 0)
    assert shown(page, SPEED) == shown(page, CURRENT) == whole
    page.evaluate(f"document.querySelector('#{SPEED} [data-zoom=in]').click()")
    assert shown(page, CURRENT) == pytest.approx((15, 45), abs=0.1)
    frequencies = shown(page, SPECTRUM)
    page.evaluate(f"document.querySelector('#{SPECTRUM} [data-zoom=in]').click()")
    low, high = shown(page, SPECTRUM)
    assert frequencies[0] < low < high < frequencies[1]
    assert (high / low) ** 2 == pytest.approx(frequencies[1] / frequencies[0], rel=0.05), "half of the decades"
    assert page.errors() == []


def test_the_legend_says_the_values_under_the_pointer_and_hides_lines(open_report: OpenReport) -> None:
    page = open_report()
    for _ in range(9):  # down to what lies around the spike, a tenth of a second
        low, high = shown(page, CURRENT)
        centre = (SPIKE_S - low) / (high - low)
        drag(page, CURRENT, max(0.0, centre - 0.25), min(1.0, centre + 0.25))
    low, high = shown(page, CURRENT)
    assert high - low < 0.2
    box = over(page, CURRENT)
    x = box["x"] + (SPIKE_S - low) / (high - low) * box["width"]
    page.command("Input.dispatchMouseEvent", {"type": "mouseMoved", "x": x, "y": box["y"] + 50})
    assert "measured9.000" in "".join(page.text(f"#{CURRENT} .legend").split())
    assert f"at {SPIKE_S:.3f}" in page.text(f"#{CURRENT} .x-label")
    assert re.search(r"at 37\.12", page.text(f"#{SPEED} .x-label")), "the pointer is in the whole group"
    button = f"document.querySelector('#{CURRENT} .legend button')"
    page.evaluate(f"{button}.click()")
    assert page.evaluate(f"{button}.getAttribute('aria-pressed')") == "false"
    page.until(f"{INKED % (CURRENT, 'c1')} == 0")
    page.evaluate(f"{button}.click()")
    page.until(f"{INKED % (CURRENT, 'c1')} > 50")
    assert page.errors() == []


@pytest.mark.parametrize("width", [360, 320])
@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_everything_without_scrolling_sideways(open_report: OpenReport, width: int, dark: bool) -> None:
    page = open_report(width, dark=dark)
    assert page.evaluate("document.documentElement.scrollWidth") == width
    outside = """[...document.querySelectorAll('body *')].filter((e) => !e.closest('.scroll, pre, .canvas')
      && e.getBoundingClientRect().right > %d).map((e) => e.outerHTML.slice(0, 80))"""
    assert page.evaluate(outside % (width + 1)) == []
    assert page.evaluate(INKED % (CURRENT, "c2")) > 200
    assert page.errors() == []


def test_a_finger_selects(open_report: OpenReport) -> None:
    page = open_report(360)
    page.command("Emulation.setTouchEmulationEnabled", {"enabled": True})
    box = over(page, CURRENT)
    y = box["y"] + box["height"] / 2
    points = [{"x": box["x"] + part * box["width"], "y": y} for part in (0.25, 0.3, 0.4, 0.5)]
    for kind, at in zip(("touchStart", "touchMove", "touchMove", "touchMove"), points, strict=True):
        page.command("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [at]})
    page.command("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    assert shown(page, SPEED) == pytest.approx((15, 30), abs=1)
    assert page.errors() == []


def test_a_window_that_changes_its_width_and_paper(open_report: OpenReport) -> None:
    page = open_report(dark=True)
    width = f"document.querySelector('#{CURRENT} canvas').getBoundingClientRect().width"
    wide = page.evaluate(width)
    page.look(700, 900, dark=True)
    page.until(f"{width} < {wide - 300}")
    narrow = page.evaluate(width)
    pdf = page.command("Page.printToPDF", {"printBackground": True})["data"]
    assert len(pdf) > 50_000
    page.until(f"{width} == {narrow}")
    assert page.evaluate(INKED % (CURRENT, "c2")) > 200
    assert page.errors() == []


def test_figures_of_nearly_nothing(open_report: OpenReport, tmp_path: Path) -> None:
    nothing, one = np.full(3, np.nan), np.zeros(1)
    three, axis, log = np.arange(3.0), Axis("a"), Axis("a", log=True)
    figures = (
        TimeSeries("one sample", one, (Line("a", one + 24),), axis),
        TimeSeries("all zero", three, (Line("a", 0 * three, 0 * three, 0 * three),), axis),
        TimeSeries("nothing known", three, (Line("a", nothing, nothing, nothing, "steps"),), axis),
        Spectrum("nothing known", three + 1, (Line("a", nothing), Line("b", -three)), log),
        Spectrum("one frequency", one + 50, (Line("a", one + 1),), log, x_axis=log),
        Scatter("nothing known", (Points("a", nothing, three),), axis, axis, (Points("c", three, nothing),)),
        Scatter("one point", (Points("a", one, one),), axis, log),
        Iterations("one iteration", one, (Line("a", one + 1e-30),), log, levels=(Mark(1e-31, "goal"), Mark(-1, "no"))),
    )
    path = tmp_path / "report.html"
    demo = demo_report(1.0)
    write_report(path, replace(demo, sections=(Section("Little", figures),)))
    page = open_report(url=path.as_uri())
    for figure in ("f1", "f2", "f5", "f8"):
        assert page.evaluate(INKED % (figure, "c1")) > 10, figure
    low, high = shown(page, "f2", "y")
    assert low < 0 < high
    assert shown(page, "f1", "y")[1] > 24
    page.evaluate("document.querySelectorAll('[data-zoom]').forEach((button) => button.click())")
    assert page.errors() == []


@pytest.mark.parametrize("admitted", [True, False])
def test_served_by_the_daemon_its_script_runs_only_where_the_policy_admits_it(
    open_report: OpenReport, browser: Browser, admitted: bool
) -> None:
    headers = {"Content-Security-Policy": content_security_policy()} if admitted else {}
    body = render_report(demo_report(10.0))

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        await Response(body, headers=headers, media_type="text/html")(scope, receive, send)

    with serving(Guard(app, tuple)) as address:
        if admitted:
            page = open_report(url=address)
            assert page.evaluate(INKED % (CURRENT, "c1")) > 200
            assert page.errors() == []
            return
        page = Page(browser)
        page.open(address)
        assert page.evaluate(DRAWN) is False
        assert "Content Security Policy" in page.errors()[0]
        assert "The simulation lacks Coulomb friction" in page.text(), "texts need no script"
        page.close()
