"""The matrix is drawn: another draw is other captures, and what a test was written for is in none of them."""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from pathlib import Path

import pytest

from tests.recovery.hidden import DRAWN, cases
from tests.recovery.matrix import options


def test_a_draw_is_the_same_again_and_shares_no_seed_with_another() -> None:
    first, again, other = (list(cases(draw, repeats=2, clean=40)) for draw in (7, 7, 8))
    assert first == again
    seeds = {c.seed for c in first}
    assert len(seeds) == len(first)
    assert not seeds & {c.seed for c in other}
    assert [c.motion for c in first] != [c.motion for c in other]
    assert all(seed in DRAWN for seed in seeds)


def test_without_a_seed_nobody_knows_the_draw_beforehand() -> None:
    fresh = [options([]) for _ in range(4)]
    assert len({o.seed for o in fresh}) == 4
    assert all(str(o.seed) in o.file.name for o in fresh)
    assert options(["--seed", "12"]).seed == 12


def test_without_a_current_its_own_faults_are_not_asked_for() -> None:
    with_it = next(c for c in cases(7) if c.cause == "current_sensor_offset")
    without = replace(with_it, current=False)
    assert with_it.shows("current_sensor_offset") and not without.shows("current_sensor_offset")
    assert with_it.key != without.key
    dry = replace(without, cause="coulomb_friction")
    assert dry.shows("coulomb_friction")
    asked = options(["--seed", "12", "--without-current"])
    assert asked.file != options(["--seed", "12"]).file


def test_no_test_holds_a_case_of_any_draw(repo_root: Path) -> None:
    texts = [(path, path.read_text(encoding="utf-8")) for path in sorted((repo_root / "tests").rglob("*.py"))]
    held = [
        f"{path.name}:{node.lineno}"
        for path, text in texts
        if any(int(digits.replace("_", "")) in DRAWN for digits in re.findall(r"\b[0-9][0-9_]*\b", text))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and type(node.value) is int and node.value in DRAWN
    ]
    assert held == []


def test_the_table_of_no_draw_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        options(["--table"])
    assert "--seed or --file" in capsys.readouterr().err
