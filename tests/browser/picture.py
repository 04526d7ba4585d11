"""A picture of the page of a running daemon, for the README, or of a report (file://…), to look at:

python -m tests.browser.picture http://127.0.0.1:8077/ docs/page.png [--width 1280] [--dark] [--seconds 60]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tests.browser.devtools import Page, browsing, chromium


def main() -> int:
    """Opens the page, lets it follow the drive for a while, and takes the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url")
    parser.add_argument("out", type=Path)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long the page is open before the picture")
    parser.add_argument("--window", default="60", help="seconds of time in the charts")
    arguments = parser.parse_args()
    with browsing(chromium() or sys.exit("chromium is not installed")) as browser:
        page = Page(browser)
        page.look(arguments.width, 900, dark=arguments.dark)
        page.open(arguments.url)
        page.until("document.body.innerText.length > 0")
        charts = "document.querySelectorAll('#parameters .card canvas').length >= 5"
        if page.evaluate("document.getElementById('parameters') !== null"):  # else it is a report
            page.until(f"!document.getElementById('fleet').hidden || {charts}")
        if page.evaluate(charts):
            choose = "const w = document.getElementById('window'); w.value = '%s'; w.dispatchEvent(new Event('change'))"
            page.evaluate(f"(() => {{ {choose % arguments.window} }})()")
        time.sleep(arguments.seconds)
        page.picture(arguments.out)
        for error in page.errors():
            print(error, file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
