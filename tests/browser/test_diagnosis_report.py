"""The report of a diagnosis in a real browser: every figure drawn, at both widths and in both colour schemes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.devtools import Browser, Page
from tests.diagnosed import dry_friction

pytestmark = pytest.mark.system

#: Figures whose canvas has nothing but its ground on it.
EMPTY = """(() => [...document.querySelectorAll('figure.plot')].filter(figure => {
  const canvas = figure.querySelector('canvas');
  if (!canvas) return true;
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d', {willReadFrequently: true});
  copy.drawImage(canvas, 0, 0);
  const data = copy.getImageData(0, 0, canvas.width, canvas.height).data;
  const colours = new Set();
  for (let k = 0; k < data.length; k += 4) colours.add((data[k] << 16) + (data[k + 1] << 8) + data[k + 2]);
  return colours.size < 8;
}).map(figure => figure.querySelector('h3').textContent))()"""


@pytest.fixture(scope="module")
def report(once: Callable[[str, Callable[[], Any]], Any], run_folder: Path) -> Path:
    """Of a motor with dry friction."""
    return dry_friction(once, run_folder).folder / "report.html"


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    page = Page(browser)
    yield page
    page.close()


@pytest.mark.first_is_fast
@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True)])
def test_every_figure_is_drawn(page: Page, report: Path, width: int, dark: bool) -> None:
    page.look(width, 900, dark=dark)
    page.open(report.as_uri())
    page.until("document.documentElement.classList.contains('drawn')")
    titles = page.evaluate("[...document.querySelectorAll('figure.plot h3')].map(h => h.textContent)")
    for title in ("Speed: one free run", "Current: measured − simulated", "Missing torque over speed"):
        assert title in titles
    assert page.evaluate(EMPTY) == []
    assert page.evaluate("document.querySelectorAll('math').length") == 1
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.text(".verdict .headline") == "Found: coulomb friction"
    assert page.errors() == []
