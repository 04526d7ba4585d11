"""A picture of parts of a report, for the documentation: the verdict and the figures whose titles are given.

python -m tests.browser.report_picture report/report.html docs/diagnosis.png "Missing force over speed"
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from tests.browser.devtools import Page, browsing, chromium

#: Leaves the title, the verdict and the figures asked for; gives how many figures those are.
KEEP = """(() => {
  const titles = %s;
  const verdict = document.querySelector('.verdict');
  const title = figure => figure.querySelector('h3')?.textContent;
  for (const part of document.querySelectorAll('nav, footer, main section > *')) {
    if (!titles.includes(title(part)) && part !== verdict) part.remove();
  }
  for (const section of document.querySelectorAll('main section')) {
    if (!section.children.length) section.remove();
  }
  return document.querySelectorAll('main figure').length;
})()"""

CLOSER = "document.querySelector('main figure [data-zoom=in]').click()"


def main() -> int:
    """Opens the report, leaves out the rest, and takes the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("titles", nargs="+")
    parser.add_argument("--width", type=int, default=1000)
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--zoom", type=int, default=0, help="so many clicks on + of the first figure")
    arguments = parser.parse_args()
    with browsing(chromium() or sys.exit("chromium is not installed")) as browser:
        page = Page(browser)
        page.look(arguments.width, 900, dark=arguments.dark)
        page.open(arguments.report.resolve().as_uri())
        page.until("document.documentElement.classList.contains('drawn')")
        kept = page.evaluate(KEEP % json.dumps(arguments.titles))
        for _ in range(arguments.zoom):
            page.evaluate(CLOSER)
        page.picture(arguments.out)
    if kept != len(arguments.titles):
        print(f"{kept} figures have these titles, not {len(arguments.titles)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
