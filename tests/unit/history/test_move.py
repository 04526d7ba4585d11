"""A history is the same in another database, and in a copy that was made while it was written."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.history import move
from servo_daemon.history.database import Database
from tests.fake_daemon import T0
from tests.unit.history.world import Drive, World


def minutes(world: World) -> np.ndarray:
    return world.archive.span("axis1", ["R"], T0 - 1, None, None, "1 min").buckets.mean


def test_moved_and_gone_on_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = World.in_folder(tmp_path)
    world.run(150.0)
    world.drives[0].log.add("alarm", "kept")
    world.turn()
    world.recorder.close()
    source, target = str(tmp_path / "history.sqlite"), str(tmp_path / "other" / "new.sqlite")
    assert move.main([source, target]) == 0
    assert capsys.readouterr().out.startswith("1 drives, 1 events, 0 documents, ")
    there = World(Database(Path(target)), drives=(Drive(),), now=world.now, monotonic=world.monotonic)
    there.turn()
    assert np.array_equal(minutes(there), minutes(world))
    there.run(60.0)
    assert there.recorder.problem is None and len(minutes(there)) == 4
    there.recorder.close()
    assert move.main([source, target]) == 2 and "has a history already" in capsys.readouterr().err
    assert move.main([str(tmp_path / "none"), target]) == 2 and "no such file" in capsys.readouterr().err
    assert move.main([]) == 2


def test_a_backup_while_it_is_written(tmp_path: Path) -> None:
    """As docs/operations.md has it."""
    world = World.in_folder(tmp_path)
    world.run(90.0)
    backup = tmp_path / "backup.sqlite"
    with closing(sqlite3.connect(tmp_path / "history.sqlite")) as file:
        file.execute(f"VACUUM INTO '{backup}'")
    seen = minutes(world)
    world.run(30.0)
    assert world.recorder.problem is None
    world.recorder.close()
    copy = World(Database(backup), drives=(Drive(),), now=T0 + 90.05, monotonic=world.monotonic)
    copy.turn()
    assert np.array_equal(minutes(copy), seen)
    copy.recorder.close()
