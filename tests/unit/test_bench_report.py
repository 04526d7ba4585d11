"""The page of measured tables: sections are replaced by what a benchmark printed, and only by that."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import report
from benchmarks.report import COMMANDS, PAGE, RESULTS, Result, assemble, load, markdown, save

RESULT = Result(
    command="python benchmarks/wire_can.py",
    date="2026-01-02",
    commit="abc1234",
    machine="2 cores",
    seconds=3.4,
    output="two lines\nof text\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\nlimit: met\n",
)
SECTIONS = "above\n<!-- bench wire-can -->\nold\n<!-- /bench -->\nbetween\n<!-- bench cost -->\nkept\n<!-- /bench -->\n"


def test_tables_stay_tables_and_text_is_shown_as_printed() -> None:
    assert markdown(RESULT) == (
        "`python benchmarks/wire_can.py` · 2026-01-02 · commit abc1234 · 2 cores · 3 s\n\n"
        "```text\ntwo lines\nof text\n```\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\n```text\nlimit: met\n```\n"
    )


def test_only_measured_sections_change() -> None:
    page = assemble(SECTIONS, {"wire-can": RESULT})
    assert page == SECTIONS.replace("old\n", markdown(RESULT))
    assert assemble(page, {"wire-can": RESULT}) == page
    assert assemble(SECTIONS, {}) == SECTIONS


@pytest.mark.parametrize(
    ("page", "says"),
    [
        (SECTIONS.replace("cost", "no-such"), "no-such"),
        (SECTIONS + SECTIONS, "twice"),
        (SECTIONS.replace("wire-can", "long"), "wire-can"),
    ],
)
def test_what_does_not_fit_is_refused(page: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        assemble(page, {"wire-can": RESULT})


def test_a_result_is_kept(tmp_path: Path) -> None:
    save(tmp_path / "results", "wire-can", RESULT)
    assert load(tmp_path / "results") == {"wire-can": RESULT}


def test_a_benchmark_is_run_and_what_it_prints_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text(SECTIONS, encoding="utf-8")
    monkeypatch.setattr(report, "PAGE", page)
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(
        report, "COMMANDS", {"wire-can": ("-c", "print('| 7 |')"), "cost": ("-c", "print('no'); raise SystemExit(3)")}
    )
    assert report.main(["--measure", "wire-can", "cost"]) == 1
    assert "| 7 |" in capfd.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert re.search(r"^\| 7 \|$", text, re.MULTILINE) and "old" not in text
    assert "kept" in text, "a benchmark that failed leaves its section as it was"


def test_the_page_holds_what_was_printed_last() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert assemble(page, load(RESULTS)) == page, "`make bench-report` brings docs/benchmarks.md up to date"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_section_is_on_the_page_and_its_benchmark_exists(name: str, repo_root: Path) -> None:
    assert f"<!-- bench {name} -->" in PAGE.read_text(encoding="utf-8")
    command = COMMANDS[name]
    path = command[1].replace(".", "/") if command[0] == "-m" else command[0]
    assert (repo_root / path).exists() or (repo_root / f"{path}.py").exists()
