"""What a worker does with one drive's captures."""

from __future__ import annotations

from pathlib import Path

import pytest

from servo_daemon.captures import write_capture
from servo_daemon.commands.fleet import work
from servo_daemon.fleet.units import Unit
from servo_daemon.simulate import simulate_capture


def test_a_capture_that_is_there_twice_is_fitted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = []
    for name, content in (("a.csv", "1"), ("b.csv", "2"), ("copy.csv", "1")):
        (tmp_path / name).write_text(content)
        names.append(str(tmp_path / name))
    fitted: list[str] = []
    monkeypatch.setattr(work, "_fitted", lambda paths, _flags: fitted.extend(p.name for p in paths) or {"fit": {}})
    document = work.fit_unit(Unit("m1", tuple(names), ("1", "1", "1")), ())
    assert fitted == ["a.csv", "b.csv"]
    assert document["repeated"] == [names[2]] and len(document["digests"]) == 2
    names[1] = str(tmp_path / "gone.csv")
    assert "gone.csv: No such file" in work.fit_unit(Unit("m1", tuple(names), ("1", "1", "1")), ())["error"]


def test_a_broken_capture_costs_a_drive_no_other(tmp_path: Path) -> None:
    block, metadata = simulate_capture(seconds=3.0, seed=5)
    names = [str(tmp_path / name) for name in ("a.csv", "b.csv", "c.csv")]
    write_capture(Path(names[0]), block, metadata=metadata)
    write_capture(Path(names[1]), block.slice(1000, 3000), metadata=metadata)
    Path(names[2]).write_text(Path(names[0]).read_text() + "abc,1,2,3\n")
    document = work.fit_unit(Unit("m1", tuple(names), ("1", "1", "1")), ())
    assert len(document["fit"]["captures"]) == len(document["digests"]) == 2
    assert document["unread"][0].startswith(names[2])
    alone = work.fit_unit(Unit("m1", (names[2],), ("1",)), ())
    assert alone["error"].startswith(names[2])
