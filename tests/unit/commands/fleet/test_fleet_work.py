"""What a worker does with one drive's captures."""

from __future__ import annotations

from pathlib import Path

import pytest

from servo_daemon.commands.fleet import work
from servo_daemon.fleet.units import Unit


def test_a_capture_that_is_there_twice_is_fitted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = []
    for name, content in (("a.csv", "1"), ("b.csv", "2"), ("copy.csv", "1")):
        (tmp_path / name).write_text(content)
        names.append(str(tmp_path / name))
    fitted: list[str] = []
    monkeypatch.setattr(work, "_fitted", lambda paths, _flags: fitted.extend(p.name for p in paths) or {"fit": {}})
    document = work.fit_unit(Unit("m1", tuple(names), (1, 1, 1)), ())
    assert fitted == ["a.csv", "b.csv"]
    assert document["repeated"] == [names[2]] and len(document["digests"]) == 2
    names[1] = str(tmp_path / "gone.csv")
    assert "gone.csv: No such file" in work.fit_unit(Unit("m1", tuple(names), (1, 1, 1)), ())["error"]
