"""The faults of `make mutants`: the named ones fit the code, and the runner tells a killed one from a survivor."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.mutants.__main__ import drawn_faults, listed_faults
from tests.mutants.groups import GROUPS, found
from tests.mutants.run import Fault, Workshop
from tests.mutants.sites import sites


@pytest.mark.parametrize("group", ["named", "mechanisms"])
def test_no_listed_fault_is_stale_and_each_has_its_tests(group: str) -> None:
    faults = list(listed_faults(group))
    assert [f.title for f in faults if f.text is None] == []
    assert len({f.title for f in faults}) == len(faults)
    for fault in faults:
        assert fault.text is not None
        ast.parse(fault.text)
        assert fault.tests


@pytest.mark.first_is_fast
@pytest.mark.parametrize("group", GROUPS)
def test_a_draw_is_the_same_again_and_every_fault_is_python(group: str, repo_root: Path) -> None:
    drawn = drawn_faults(group, 40, 3)
    assert drawn == drawn_faults(group, 40, 3)
    assert drawn != drawn_faults(group, 40, 4)
    assert len(found(repo_root, GROUPS[group].tests)) >= 1
    for fault in drawn:
        assert fault.text is not None
        assert ast.dump(ast.parse(fault.text)) != ast.dump(ast.parse((repo_root / fault.file).read_text("utf-8")))


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("y = a < b\n", {"(a >= b)"}),
        ("y = not a\n", {"(a)"}),
        ("y = 3 * a\n", {"300"}),
        ("y = 0.0\n", {"1.0"}),
        ("if a and b:\n    pass\n", {"(not (a and b))"}),
        ("y: float = a if b else c\n", {"(not (b))"}),
        ("assert a < 3\n", set()),
        ("raise E(f'{a:5.3f}', 3)\n", set()),
        ('"""µ"""\ny = a is None\n', {"(a is not None)"}),
    ],
)
def test_what_is_changed(source: str, expected: set[str]) -> None:
    found_there = sites(source)
    assert {s.new for s in found_there} == expected
    for site in found_there:
        assert source[: source.index(site.old)] + site.new in site.applied(source)


@pytest.mark.slow
def test_a_test_that_fails_kills_and_the_fault_is_gone_afterwards(tmp_path: Path) -> None:
    tree = tmp_path / "tree"
    tree.mkdir()
    (tree / "double.py").write_text("def double(x):\n    return 2 * x\n")
    (tree / "test_double.py").write_text("import double\n\ndef test_it():\n    assert double.double(0) == 0\n")
    (tree / "pyproject.toml").write_text("[tool.pytest.ini_options]\nmarkers = ['slow']\n")
    workshop = Workshop(tree, tmp_path / "copy")
    outcomes = [
        workshop.judge(Fault("g", text or "stale", "double.py", text, ("test_double.py",)))
        for text in ("def double(x):\n    return 3 * x\n", "def double(x):\n    return 2 + x\n", None)
    ]
    assert [o.outcome for o in outcomes] == ["survived", "killed", "stale"]
    assert outcomes[1].by == "test_double.py::test_it"
    assert (tmp_path / "copy/double.py").read_text() == (tree / "double.py").read_text()


@pytest.mark.slow
def test_tests_that_fail_by_themselves_kill_nothing(tmp_path: Path) -> None:
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree/test_it.py").write_text("def test_it():\n    assert False\n")
    (tmp_path / "tree/pyproject.toml").write_text("[tool.pytest.ini_options]\nmarkers = ['slow']\n")
    workshop = Workshop(tmp_path / "tree", tmp_path / "copy")
    with pytest.raises(RuntimeError, match="test_it"):
        workshop.judge(Fault("g", "t", "test_it.py", "", ("test_it.py",)))
