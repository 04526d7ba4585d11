"""The dashboard in a real browser."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from servo_daemon.published.snapshot import EstimatorView, Event, ParameterEstimate
from tests.browser.conftest import PAST_S, LiveServer
from tests.browser.devtools import Page
from tests.fake_daemon import NOMINAL, live_snapshot
from tests.system.harness import wait_for

pytestmark = pytest.mark.system
OpenPage = Callable[..., Page]

#: Times of a card's chart.
TIMES = """import('/assets/chart.js').then(({charts}) => {
  const element = document.querySelector('[data-name=%s] .chart');
  return [...charts].find((c) => c.element === element).plot.data[0];
})"""

#: How many pixels of a card's canvas have the colour of the estimate.
INKED = """(() => {
  const canvas = document.querySelector('[data-name=%s] canvas');
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  const probe = document.createElement('i');
  probe.style.color = 'var(--estimate)';
  document.body.append(probe);
  const [r, g, b] = getComputedStyle(probe).color.match(/\\d+/g).map(Number);
  probe.remove();
  let inked = 0;
  for (let k = 0; k < data.length; k += 4)
    if (Math.abs(data[k] - r) + Math.abs(data[k + 1] - g) + Math.abs(data[k + 2] - b) < 12) inked++;
  return inked;
})()"""


def test_values_and_charts(open_page: OpenPage, server: LiveServer, tmp_path: Path) -> None:
    page = open_page()
    card = page.text("[data-name=R]")
    assert re.search(r"R\s+resistance", card)
    assert "tracking" in card
    assert re.search(r"49\d\.\d+ ± [\d.]+ mΩ", " ".join(card.split()))
    assert "nominal 701.1" in card
    assert re.search(r"−29\.\d+ %|−30\.\d+ %", card)
    assert "true 493.7" in card
    assert "×10⁻³ kg·m²" in page.text("[data-name=J]")
    assert "N·m·s/rad" in page.text("[data-name=B]")
    for name in ("R", "L", "K", "J", "B", "current_A", "velocity_rad_s", "position_rad"):
        assert page.until(INKED % name) > 200, name
    assert page.text("#rate") == "1000 Hz"
    assert page.text("#lost") == "0"
    assert page.evaluate("document.getElementById('truth-key').hidden") is False
    times = page.evaluate(TIMES % "R")
    assert times[-1] - times[0] > PAST_S - 1, "the history before the page was opened"
    assert times == sorted(times)
    page.picture(tmp_path / "page.png")
    assert (tmp_path / "page.png").read_bytes().startswith(b"\x89PNG")
    assert page.errors() == []


def test_numbers_follow_the_stream(open_page: OpenPage) -> None:
    page = open_page()
    steps = "import('/assets/format.js').then(f => [2, 2.5, 0.25, 0.5, 20, 25, 1e-3].map(f.stepDecimals))"
    assert page.evaluate(steps) == [0, 1, 2, 1, 0, 0, 3], "the distance of ticks as it is"
    typeset = "import('/assets/format.js').then(f => f.typeset('axis-1: -0.3 % from 2026-11-27 in 5 s'))"
    assert page.evaluate(typeset) == "axis-1: −0.3\u00a0% from 2026-11-27 in 5\u00a0s"
    before = page.text("[data-name=velocity_rad_s] .number")
    last = page.evaluate(TIMES % "R")[-1]
    page.until(f"document.querySelector('[data-name=velocity_rad_s] .number').innerText != {json.dumps(before)}")
    page.until((TIMES % "R") + f".then((times) => times.at(-1) > {last + 0.5})")
    assert page.errors() == []


@pytest.mark.parametrize("width", [360, 320])
@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_everything_without_scrolling_sideways(open_page: OpenPage, width: int, dark: bool) -> None:
    page = open_page(width, dark=dark)
    assert page.evaluate("document.documentElement.scrollWidth") == width
    wide = "[...document.querySelectorAll('body *')].filter((e) => e.getBoundingClientRect().right > %d).length"
    assert page.evaluate(wide % (width + 1)) == 0
    assert page.until(INKED % "R") > 100
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", ground))) < 150) == dark
    assert page.errors() == []


def test_a_drive_that_is_down(open_page: OpenPage, server: LiveServer) -> None:
    page = open_page()
    server.paused.add("axis1")
    server.axis1.lose("down", "/dev/ttyUSB0 is gone")
    server.axis1.log.append(Event(server.started, "disconnected", "/dev/ttyUSB0 is <gone>", {"after_s": 3.50000000004}))
    page.until("document.getElementById('connection').dataset.state == 'down'")
    banner = page.text("#banner")
    assert "axis1" in banner
    assert "/dev/ttyUSB0 is gone" in banner
    page.until("document.querySelector('[data-name=R] .badge').dataset.status == 'invalid'")
    assert "/dev/ttyUSB0 is gone" in page.text("[data-name=R] .reason")
    assert page.text("[data-name=R] .number") != "–"
    page.until("document.querySelectorAll('#events li').length == 1")
    assert "/dev/ttyUSB0 is <gone> (after 3.5 s)" in page.text("#events")
    assert "axis1 (down)" in page.evaluate("document.getElementById('drive').options[1].text")
    server.paused.clear()
    page.until("document.getElementById('banner').hidden")
    page.until("document.querySelector('[data-name=R] .badge').dataset.status == 'tracking'")
    assert page.errors() == []


def test_a_lost_daemon_is_said_and_the_gap_filled_afterwards(open_page: OpenPage, server: LiveServer) -> None:
    page = open_page()
    server.stop_serving()
    page.until("document.getElementById('connection').dataset.state == 'lost'")
    assert "does not answer" in page.text("#banner")
    last = page.evaluate(TIMES % "R")[-1]
    page.until(f"Date.now() / 1000 > {last + 4}")
    server.asked.clear()
    server.serve()
    page.until("document.getElementById('connection').dataset.state == 'connected'")
    page.until((TIMES % "R") + f".then((times) => times.at(-1) > {last + 4})")  # a gap of 3 s would be shown as one
    times = page.evaluate(TIMES % "R")
    assert max(b - a for a, b in pairwise(times)) < 1.0
    refills = [path for path in server.asked if "/history?parameter=R&" in path]
    assert refills
    assert "start=20" in refills[0], "only what was missed is asked for"


PUT_AWAY = "(() => { window.put_away = %s; document.dispatchEvent(new Event('visibilitychange')); })()"


def goes_on(page: Page, seconds: float) -> None:
    """Until its curve is so much longer."""
    page.until((TIMES % "R") + f".then((times) => times.at(-1) > {page.evaluate(TIMES % 'R')[-1] + seconds})")


@pytest.mark.slow
def test_more_windows_than_a_browser_has_connections(open_page: OpenPage, server: LiveServer) -> None:
    """Chromium and Firefox open six to one host, all tabs together."""
    pages = [open_page(seen=True) for _ in range(8)]
    for page in pages:
        goes_on(page, 1)
    wait_for(lambda: server.streams == 4, "the others ask once a second")
    asked = len(server.asked)
    pages[0].evaluate(PUT_AWAY % "true")
    wait_for(
        lambda: any(path.endswith("/stream") for path in server.asked[asked:]), "the next in the row has its place"
    )
    wait_for(lambda: server.streams == 4, "a hidden tab has none")
    pages[0].evaluate(PUT_AWAY % "false")
    goes_on(pages[0], 3)
    gaps = [b - a for a, b in pairwise(pages[0].evaluate(TIMES % "R"))]
    assert max(gaps) < 3, "what was missed is there: a gap of 3 s would be shown as one"
    assert server.streams == 4, "it stands at the end of the row"
    assert all(page.errors() == [] for page in pages)


def test_a_hidden_page_asks_nothing(open_page: OpenPage, server: LiveServer) -> None:
    hidden, seen = open_page(fragment="#axis2", seen=True), open_page(seen=True)
    hidden.evaluate(PUT_AWAY % "true")
    goes_on(seen, 1)  # what was asked before has been answered
    asked = len(server.asked)
    goes_on(seen, 4)
    since = server.asked[asked:]
    assert not [path for path in since if "axis2" in path]
    assert since.count("/api/v1/drives") <= 1 < since.count("/api/v1/drives/axis1"), "the list is asked for seldom"
    hidden.evaluate(PUT_AWAY % "false")
    goes_on(hidden, 1)


def test_the_other_drive(open_page: OpenPage, server: LiveServer) -> None:
    page = open_page()
    server.paused.add("axis2")
    server.daemon.drives["axis2"].lose("silent", "nothing arrives")
    choose = "const d = document.getElementById('drive'); d.value = 'axis2'; d.dispatchEvent(new Event('change'))"
    page.evaluate(f"(() => {{ {choose} }})()")
    page.until("document.getElementById('connection').dataset.state == 'silent'")
    assert "axis2" in page.text("#banner")
    assert page.evaluate("document.title") == "axis2 · servo-daemon"
    assert page.evaluate("location.hash") == "#axis2"
    page.until("document.querySelectorAll('#parameters .card').length == 5")
    assert page.evaluate("document.querySelectorAll('.uplot').length") == 8
    assert page.errors() == []


def test_the_address_chooses_the_drive(open_page: OpenPage) -> None:
    page = open_page(fragment="#axis2")
    assert page.evaluate("document.getElementById('drive').value") == "axis2"
    page.evaluate("location.hash = '#axis1'")
    page.until("document.title.startsWith('axis1')")
    page.until("document.getElementById('drive').value == 'axis1'")


def test_cards_follow_the_model(open_page: OpenPage, server: LiveServer) -> None:
    page = open_page()
    server.paused.add("axis1")
    live = live_snapshot("axis1", server.started)
    assert live.estimate is not None
    friction = ParameterEstimate("Tc", 0.0121, 0.0004, "N·m", None, "unexcited", "the motor stands still")
    extended = replace(live.estimate, model=("coulomb_friction",), parameters=(*live.estimate.parameters, friction))
    server.axis1.publish(replace(live, estimate=extended))
    card = "document.querySelector('[data-name=Tc]')"
    page.until(f"{card} && {card}.innerText.includes('unexcited')")
    text = " ".join(page.text("[data-name=Tc]").split())
    assert "12.10 ± 0.40 mN·m" in text
    assert "no nominal value" in text
    assert "the motor stands still" in text
    page.until("document.getElementById('model').textContent == 'linear motor + coulomb friction'")
    server.paused.clear()
    page.until(f"{card} === null")
    assert page.errors() == []


def test_before_the_first_samples(open_page: OpenPage, server: LiveServer) -> None:
    server.paused.add("axis2")
    server.daemon.drives["axis2"].current = None
    server.daemon.drives["axis2"].history = type(server.axis1.history)()
    page = open_page()
    page.evaluate("location.hash = '#axis2'")
    page.until("document.getElementById('connection').dataset.state == 'connecting'")
    page.until("document.querySelector('[data-name=R] .badge')?.dataset.status == 'estimating'")
    assert "no samples yet" in page.text("[data-name=R] .reason")
    assert "port is opened" in page.text("#banner")
    assert "701.1" in page.text("[data-name=R] .number")
    assert NOMINAL["R"] == 0.7011
    server.paused.clear()
    page.until("document.querySelector('[data-name=R] .badge').dataset.status == 'tracking'")
    assert page.errors() == []


def test_reset_asks_first(open_page: OpenPage, server: LiveServer) -> None:
    page = open_page()
    page.evaluate("window.confirm = () => false")
    page.evaluate("document.getElementById('reset').click()")
    page.evaluate("window.confirm = (question) => (window.asked = question, true)")
    page.evaluate("document.getElementById('reset').click()")
    page.until("window.asked?.includes('axis1')")
    page.until("performance.getEntriesByType('resource').some((e) => e.name.endsWith('/reset'))")
    assert server.axis1.resets == 1
    assert page.errors() == []


def test_keyboard_and_screen_reader(open_page: OpenPage) -> None:
    page = open_page()
    reached = []
    while "reset" not in reached and len(reached) < 40:
        page.press("Tab", 9)
        reached.append(page.evaluate("document.activeElement.id || document.activeElement.textContent"))
    assert reached[:2] == ["drive", "window"]
    assert {"diagnose", "scope-run", "download", "reset"} <= set(reached)
    assert page.evaluate("[...document.querySelectorAll('select')].every((s) => s.labels.length == 1)")
    page.until("[...document.querySelectorAll('.chart')].every((c) => c.getAttribute('aria-label')?.includes('now'))")
    assert page.evaluate("document.querySelector('[role=status]').id") == "connection"
    assert page.evaluate("document.documentElement.lang") == "en"


#: Text on ground, by the names of the style sheet's variables.
PAIRS = (
    ("ink", "surface"),
    ("ink", "ground"),
    ("ink-2", "surface"),
    ("ink-2", "ground"),
    ("accent", "ground"),
    ("truth", "surface"),
    ("good", "good-ground"),
    ("warn", "warn-ground"),
    ("bad", "bad-ground"),
    ("bad", "surface"),
    ("idle", "idle-ground"),
)


def _luminance(colour: str) -> float:
    """Relative luminance, WCAG 2.2."""
    channels = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("dark", [False, True])
def test_contrast(open_page: OpenPage, dark: bool) -> None:
    page = open_page(dark=dark)
    for text, ground in PAIRS:
        read = "getComputedStyle(document.documentElement).getPropertyValue('--%s').trim()"
        a, b = (_luminance(page.evaluate(read % name)) for name in (text, ground))
        ratio = (max(a, b) + 0.05) / (min(a, b) + 0.05)
        assert ratio >= 4.5, f"{text} on {ground}: {ratio:.2f}"


FORMATS = [
    ("pair(0.493312, 0.00078, scaleFor('Ω', 0.4933))", {"value": "493.31", "std": "± 0.78"}),
    ("pair(1234.5, 12, scaleFor('Ω', 1234.5))", {"value": "1.234", "std": "± 0.012"}),
    ("pair(0.009779, 0.000026, scaleFor('kg·m²', 0.009779))", {"value": "9.779", "std": "± 0.026"}),
    ("pair(-0.0121, 0.0004, scaleFor('N·m', -0.0121))", {"value": "−12.10", "std": "± 0.40"}),
    ("pair(5.0, 300, scaleFor('Ω', 5))", {"value": "5", "std": "± 300"}),
    ("pair(0.5, null, scaleFor('V', 0.5))", {"value": "500.0", "std": ""}),
    ("pair(null, null, scaleFor('V', 0))", {"value": "–", "std": ""}),
    ("scaleFor('H', 2.3e-3)", {"factor": 1e-3, "unit": "mH"}),
    ("scaleFor('H', 1e-6)", {"factor": 1e-6, "unit": "µH"}),
    ("scaleFor('rad/s', 5000)", {"factor": 1, "unit": "rad/s"}),
    ("scaleFor('°C', 0.001)", {"factor": 1, "unit": "°C"}),
    ("scaleFor('', 0.3)", {"factor": 1, "unit": ""}),
    ("scaleFor('Ω', 1500, {factor: 1, unit: 'Ω'})", {"factor": 1, "unit": "Ω"}),
    ("scaleFor('Ω', 2500, {factor: 1, unit: 'Ω'})", {"factor": 1e3, "unit": "kΩ"}),
    ("scaleFor('kg·m²', 0.0098).unit", "×10⁻³ kg·m²"),
    ("scaleFor('kg·m²', 9.8e-6).unit", "×10⁻⁶ kg·m²"),
    ("fixed(-0.0001, 2)", "0.00"),
    ("fixed(NaN, 2)", "–"),
    ("percent(-0.2954)", "−29.5 %"),
    ("percent(0.0123)", "+1.23 %"),
    ("percent(0)", "±0.00 %"),
    ("percent(12.5)", "+1250 %"),
    ("count(1234567)", "1\u202f234\u202f567"),
    ("plain(3.18766)", "3.188"),
    ("plain(13.46)", "13.46"),
]


def test_numbers_as_engineers_write_them(open_page: OpenPage) -> None:
    page = open_page()
    names = "{pair, scaleFor, fixed, percent, count, plain}"
    for call, expected in FORMATS:
        got = page.evaluate(f"import('/assets/format.js').then(({names}) => {call})")
        assert got == (pytest.approx(expected) if isinstance(expected, float) else expected), call


def test_a_long_running_page_keeps_a_bounded_number_of_points(open_page: OpenPage) -> None:
    page = open_page()
    script = """import('/assets/series.js').then(({Series}) => {
      const series = new Series(300);
      let most = 0;
      for (let k = 0; k < 100000; k++) {
        series.push(1000 + k / 10, Math.sin(k), 0.1, null);
        most = Math.max(most, series.columns[0].length);
      }
      return [most, series.columns[0][0], series.lastTime, new Set(series.columns.map((c) => c.length)).size];
    })"""
    most, first, last, lengths = page.evaluate(script)
    assert most <= 1.1 * 2 * 1500 + 2  # two points for each of the 1500 that a chart can show, and what is trimmed late
    assert last == pytest.approx(1000 + 9999.9)
    assert last - 331 < first <= last - 300
    assert lengths == 1


MARKS = """import('/assets/chart.js').then(({charts}) => {
  const element = document.querySelector('[data-name=%s] .chart');
  return [...charts].find((c) => c.element === element).marks.map((m) => [m.value, m.std, m.applied]);
})"""


def test_windows_of_the_learned_model_are_marks_on_the_curves(open_page: OpenPage, server: LiveServer) -> None:
    server.paused.add("axis1")

    def publish(end_s: float | None, applied: int, mode: str = "trusted", **more: object) -> None:
        snapshot = live_snapshot("axis1", server.started)
        assert snapshot.estimate is not None
        detail = {"mode": mode, "window_end_s": end_s, "applied": applied, "reason": None, "declined": None} | more
        view = EstimatorView({"R": (0.5, 0.01)} if end_s is not None else {}, detail)  # type: ignore[arg-type]
        estimators = {**snapshot.estimate.estimators, "grnn": view}
        server.axis1.publish(replace(snapshot, estimate=replace(snapshot.estimate, estimators=estimators)))

    publish(None, 0, "training", motors_done=1200, motors=5000)
    page = open_page()
    page.until("document.getElementById('learned').textContent == 'training, 1\u202f200 of 5\u202f000'")
    assert page.evaluate("document.getElementById('learned-key').hidden") is True
    publish(5.0, 0, "shadow")
    page.until("document.getElementById('learned').textContent == 'shadow'")
    publish(10.0, 1)
    page.until((MARKS % "R") + ".then((marks) => marks.length == 2)")
    assert page.evaluate(MARKS % "R") == [[0.5, 0.01, False], [0.5, 0.01, True]]
    assert page.evaluate(MARKS % "L") == []
    assert page.evaluate("document.getElementById('learned-key').hidden") is False
    publish(10.0, 1, declined="the window is unlike those of the training")
    page.until("document.getElementById('learned').textContent == 'declined'")
    assert len(page.evaluate(MARKS % "R")) == 2
    assert page.errors() == []
