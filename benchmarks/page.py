"""The page of a daemon with many drives in a real browser: how soon it is there, and what open tabs cost the daemon.

Chromium opens the fleet and the view of a drive, its cache off, over loopback; how long that took is the browser's own
`first-contentful-paint`, and the moment at which the last row (or card) of the page was in the document. Then CPU of
the daemon and of the processes that it started, over equal stretches: nobody looks, ten tabs show the fleet, ten tabs
show a drive each. What tabs cost is the difference to the mean of the quiet stretches before and after.

    .venv/bin/python -m benchmarks.page                  32 drives at 1 kHz, 10 tabs, 15 s a stretch: 3 minutes
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.daemon import STARTED_S, Api, come_up_s, cpu_s, daemon, tables_of, wait_for_samples
from benchmarks.feeder import fed_drives
from tests.browser.devtools import Browser, Page, browsing, chromium

OPENINGS = 10
#: Tabs load scripts and the past first; what they cost while they stay open is asked for after so long, s.
SETTLE_S = 8.0
FLEET = "document.querySelectorAll('#fleet-rows tr').length >= {drives}"
VIEW = "document.querySelectorAll('#parameters .card').length >= 5"
_WATCH = """(() => {
  const look = () => {
    if (window.whole_ms === undefined && document.body && (%s)) window.whole_ms = performance.now();
  };
  new MutationObserver(look).observe(document, { childList: true, subtree: true });
})()"""
_PAINT = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime"


def opened(browser: Browser, url: str, whole: str) -> tuple[float, float]:
    """The first paint, and the moment at which `whole` became true, ms after the navigation began."""
    page = Page(browser)
    try:
        page.look(1440, 900)
        page.command("Network.setCacheDisabled", {"cacheDisabled": True})
        page.command("Page.addScriptToEvaluateOnNewDocument", {"source": _WATCH % whole})
        page.open(url)
        return float(page.until(_PAINT)), float(page.until("window.whole_ms"))
    finally:
        page.close()


def tree_cpu_s(pid: int) -> float:
    """CPU time of a process and of its children that live, s."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return cpu_s(pid) + sum(cpu_s(int(child)) for child in children)


def used_percent(pid: int, seconds: float) -> float:
    """Of a core, over so long."""
    cpu, began = tree_cpu_s(pid), time.monotonic()
    time.sleep(seconds)
    return 100 * (tree_cpu_s(pid) - cpu) / (time.monotonic() - began)


@contextlib.contextmanager
def tabs(browser: Browser, urls: Sequence[str], there: str) -> Iterator[None]:
    """These pages, open; what they complained of fails the run."""
    pages = [Page(browser) for _ in urls]
    try:
        for page, url in zip(pages, urls, strict=True):
            page.look(1440, 900)
            page.be_seen()
            page.open(url)
        for page in pages:
            page.until(there)
        time.sleep(SETTLE_S)
        yield
        if errors := [error for page in pages for error in page.errors()]:
            raise SystemExit(f"the page complains: {errors[0]}")
    finally:
        for page in pages:
            page.close()


def measure(pid: int, url: str, drives: int, number: int, seconds: float) -> list[str]:
    """Lines of the table."""
    fleet, lines = FLEET.format(drives=drives), []
    with browsing(chromium() or sys.exit("chromium is not installed")) as browser:
        for what, address, whole in (("fleet", url, fleet), ("a drive's view", f"{url}#axis0", VIEW)):
            took = np.array([opened(browser, address, whole) for _ in range(OPENINGS)])
            for when, column, wanted in (("first paint", 0, "≤ 1000"), ("all rows or cards there", 1, "")):
                p50, most = np.median(took[:, column]), took[:, column].max()
                lines.append(f"| {what}: {when}, ms: median, most of {OPENINGS} | {p50:.0f}, {most:.0f} | {wanted} |")
        stretch: Callable[[], float] = lambda: used_percent(pid, seconds)  # noqa: E731
        quiet = [stretch()]
        for what, addresses, whole in (
            ("the fleet", [url] * number, fleet),
            ("a drive each", [f"{url}#axis{k}" for k in range(number)], VIEW),
        ):
            with tabs(browser, addresses, whole):
                busy = stretch()
            time.sleep(2.0)  # the last connections end
            quiet.append(stretch())
            cost = busy - (quiet[-2] + quiet[-1]) / 2
            lines.append(f"| {number} tabs with {what}, % of a core more than without | {cost:.1f} | ≤ 10 |")
    spread = " ".join(f"{q:.1f}" for q in quiet)
    return [*lines, f"| the daemon without tabs, % of a core: each quiet stretch | {spread} | |"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=32)
    parser.add_argument("--tabs", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=15.0, help="of a stretch")
    a = parser.parse_args()
    enough_s = come_up_s(a.drives) + STARTED_S + 5 * a.seconds + 2 * SETTLE_S + 120
    with (
        tempfile.TemporaryDirectory() as name,
        fed_drives(a.drives, Path(name), enough_s) as (links, _),
        daemon(tables_of(links), Path(name)) as (pid, port),
    ):
        wait_for_samples(Api(port), a.drives)
        time.sleep(STARTED_S)
        lines = measure(pid, f"http://127.0.0.1:{port}/", a.drives, a.tabs, a.seconds)
    print(f"{a.drives} drives at 1 kHz on serial wire; {a.seconds:.0f} s a stretch\n")
    print("\n".join(["| | measured | wanted |", "|---|---|---|", *lines]))


if __name__ == "__main__":
    main()
