"""Which captures belong to which drive."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from servo_daemon.errors import BadInputError
from servo_daemon.fleet.units import find_units


def touch(path: Path, text: str = "x") -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return str(path)


def test_sub_folders_are_drives_and_loose_captures_one_each(tmp_path: Path) -> None:
    for name in ("line1/axis2/b.csv", "line1/axis2/a.csv.gz", "line1/axis3/c.parquet", "loose.csv", "line1/notes.md"):
        touch(tmp_path / name)
    alone = touch(tmp_path / "elsewhere" / "one.mat")
    units = find_units([str(tmp_path), alone])
    assert [u.name for u in units] == ["elsewhere", "line1/axis2", "line1/axis3", "loose", "one"]
    assert [Path(c).name for c in units[1].captures] == ["a.csv.gz", "b.csv"]


def test_the_drives_name_is_found_in_the_path(tmp_path: Path) -> None:
    for name in ("2026-01/axis7_run1.csv", "2026-02/axis7_run2.csv", "2026-02/axis8_run1.csv"):
        touch(tmp_path / name)
    units = find_units([str(tmp_path)], r"(axis\d+)_")
    assert [(u.name, len(u.captures)) for u in units] == [("axis7", 2), ("axis8", 1)]


def test_urls_are_listed_through_fsspec(tmp_path: Path) -> None:
    fsspec = pytest.importorskip("fsspec", reason="the extra dask is not installed")
    fs = fsspec.filesystem("memory")
    for name in ("axis1/a.csv", "axis1/b.csv", "axis2/a.csv"):
        fs.pipe_file(f"/bench/{tmp_path.name}/{name}", b"x")
    units = find_units([f"memory://bench/{tmp_path.name}"])
    assert [(u.name, len(u.captures)) for u in units] == [("axis1", 2), ("axis2", 1)]
    assert all(version.startswith("1 ") for u in units for version in u.versions)
    assert units[1].captures[0].startswith("memory://")


def test_a_unit_is_computed_anew_when_a_capture_or_the_question_changes(tmp_path: Path) -> None:
    path = touch(tmp_path / "axis" / "a.csv")
    before = find_units([str(tmp_path)])[0]
    assert before.key("fit") == find_units([str(tmp_path)])[0].key("fit") != before.key("diagnose")
    Path(path).write_text("longer")
    assert find_units([str(tmp_path)])[0].key("fit") != before.key("fit")
    Path(path).write_text("x")  # as long as it was, and another moment
    os.utime(path, ns=(0, 0))
    assert find_units([str(tmp_path)])[0].key("fit") != before.key("fit")


@pytest.mark.parametrize(
    ("place", "regex", "said"),
    [
        ("nowhere", None, "no such file or folder"),
        (".", None, "holds no capture"),
        (".", "axis", "no group"),
        (".", "(", "--drive-from"),
        ("noplace://x", None, "noplace"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, place: str, regex: str | None, said: str) -> None:
    touch(tmp_path / "readme.md")
    where = place if "://" in place else str(tmp_path / place)
    with pytest.raises(BadInputError, match=said):
        find_units([where], regex)
