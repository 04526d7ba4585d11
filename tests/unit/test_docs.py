"""The documents: every link leads somewhere, every path that is named exists, README and records keep their size."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).resolve().parents[2]
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"`[^`\n]*`")
_LINK = re.compile(r"!?\[[^\]]*\]\(([^()\s]+(?:\([^()\s]*\)[^()\s]*)*)\)")
_HEADING = re.compile(r"^#{1,6} +(.+?) *#*$", re.MULTILINE)


def tracked(pattern: str) -> list[Path]:
    """Files that belong to the project, whether committed or not yet."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", pattern]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [path for line in listed.stdout.splitlines() if (path := ROOT / line).exists()]


PAGES = tracked("*.md")


def anchors(text: str) -> set[str]:
    """Of every heading, as GitHub makes them; the second one alike ends in -1."""
    found: set[str] = set()
    for heading in _HEADING.findall(_FENCE.sub("", text)):
        plain = _LINK.sub(lambda m: m[0][m[0].index("[") + 1 : m[0].index("]")], heading).replace("`", "")
        slug = re.sub(r"[^\w\- ]", "", plain.strip().lower()).replace(" ", "-")
        number = 0
        while (anchor := f"{slug}-{number}" if number else slug) in found:
            number += 1
        found.add(anchor)
    return found


def dead_links(page: Path) -> Iterator[str]:
    """Links of a page to files or headings that are not there. What is code is no link; the web is not asked."""
    text = _CODE.sub("", _FENCE.sub("", page.read_text(encoding="utf-8")))
    for link in _LINK.findall(text):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = unquote(link).partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists():
            yield f"{link}: no such file"
        elif anchor and (target.suffix != ".md" or anchor not in anchors(target.read_text(encoding="utf-8"))):
            yield f"{link}: no such heading"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_link_is_dead(page: Path) -> None:
    assert list(dead_links(page)) == []


def test_a_dead_link_is_found(tmp_path: Path) -> None:
    page = tmp_path / "a.md"
    (tmp_path / "b.md").write_text("# Two words: `x`\n## Twice\n## Twice\n```\n# no heading\n```\n", encoding="utf-8")
    page.write_text(
        "# Here\n[1](b.md#two-words-x) [2](b.md#twice-1) [3](#here) [4](https://x.y/z) `[5](c.md)`\n"
        "[6](c.md) [7](b.md#three) [8](#no-heading) ![9](d.png)\n",
        encoding="utf-8",
    )
    assert [entry.split(":")[0] for entry in dead_links(page)] == ["c.md", "b.md#three", "#no-heading", "d.png"]


def test_every_page_and_picture_is_linked() -> None:
    linked = {
        (page.parent / link.partition("#")[0]).resolve()
        for page in PAGES
        for link in _LINK.findall(_CODE.sub("", page.read_text(encoding="utf-8")))
    }
    # `docs/tracking` holds one picture of each scenario, as the benchmark draws them, whether a page shows it or not.
    files = {p for pattern in ("docs/*.md", "docs/*.png") for p in tracked(pattern) if p.parent == ROOT / "docs"}
    assert sorted(files - linked) == []


@pytest.mark.parametrize("name", ["docs/architecture.md", "CONTRIBUTING.md"])
def test_every_path_that_is_named_exists(name: str) -> None:
    text = _FENCE.sub("", (ROOT / name).read_text(encoding="utf-8"))
    named = re.findall(r"`((?:[a-z_]+/)+(?:[a-z_]+\.[a-z]+)?)`", text)
    assert len(named) > 5
    places = (ROOT, ROOT / "servo_daemon")
    assert [path for path in named if not any((place / path).exists() for place in places)] == []


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_decisions_are_numbered_and_short() -> None:
    text = (ROOT / "docs" / "decisions.md").read_text(encoding="utf-8")
    records = re.findall(r"^\*\*(\d+)\. (.*?)(?=\n\n|\Z)", text, re.MULTILINE | re.DOTALL)
    assert [int(number) for number, _ in records] == list(range(1, len(records) + 1))
    assert [number for number, record in records if len(record.splitlines()) >= 15] == []
