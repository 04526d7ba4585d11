"""The same store in a real PostgreSQL."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from servo_daemon.config import HistoryConfig
from servo_daemon.errors import ConfigError
from servo_daemon.history.database import Database
from servo_daemon.history.move import move
from tests import postgresql
from tests.fake_daemon import T0
from tests.unit.history.world import Drive, World


@pytest.fixture(scope="module")
def url(missing: Callable[[str], NoReturn]) -> Iterator[str]:
    if postgresql.find("initdb") is None:
        missing("initdb: PostgreSQL's server (Debian: postgresql)")
    with tempfile.TemporaryDirectory(prefix="pg") as folder:  # a socket's path must be short, and readable by its user
        Path(folder).chmod(0o755)
        with postgresql.server(Path(folder)) as found:
            yield found


@pytest.mark.slow
@pytest.mark.system
def test_a_life_in_postgresql(url: str) -> None:
    world = World(Database(None, url), HistoryConfig(rows_hours=0.1))
    deadline = time.monotonic() + 30.0
    while not world.recorder.turn(world.now, world.monotonic) and world.recorder.problem is not None:
        assert time.monotonic() < deadline, world.recorder.problem
        world.monotonic += 10.0  # the server is starting: the outage is told and over by itself
    world.run(400.0)
    world.drives[0].log.add("alarm", "R is high", {"value": 1.5})
    world.diagnose({"verdict": "none", "effects": []})
    world.turn()
    world.restart()
    world.run(300.0)
    world.run(2.0, turns=False)
    for level, period_s in (("rows", 0.0), ("1 s", 1.0), ("1 min", 60.0), ("1 h", 3600.0)):
        buckets = world.archive.span("axis1", ["R"], T0 - 1, None, None, level).buckets
        assert buckets.count.sum() == 7020, level
        assert buckets.period_s == period_s
        assert (buckets.count[:, 0] @ buckets.mean[:, 0]) / 7020 == pytest.approx(
            sum(world.truth.values()) / 7020, abs=0.01 / 16
        )
    assert world.archive.documents("axis1", "diagnosis", 1)[0].body["result"]["verdict"] == "none"
    world.now, world.monotonic = world.now + 3700.0, world.monotonic + 3700.0
    world.run(63.0)
    world.now = T0 * 1e3
    assert [e.data for e in world.archive.events("axis1", ["alarm"], None, 5, None).events] == [{"value": 1.5}]
    rows = world.archive.span("axis1", ["R"], T0 - 1, None, None, "rows").buckets
    assert len(rows) == 630, "pruned"
    engine = world.recorder.engine
    assert engine is not None
    with engine.connect() as connection:
        assert 10_000 < world.database.size_bytes(connection) < 10_000_000
    world.recorder.close()


@pytest.mark.slow
@pytest.mark.system
def test_a_file_moved_to_postgresql_is_gone_on_with(url: str, tmp_path: Path) -> None:
    other = url.replace("/postgres?", "/template1?")  # a database of its own
    world = World.in_folder(tmp_path)
    world.run(90.0)
    world.recorder.close()
    move(Database(tmp_path / "history.sqlite"), Database(None, other))
    there = World(Database(None, other), drives=(Drive(),), now=world.now, monotonic=world.monotonic, truth=world.truth)
    there.turn()
    there.run(60.0)
    assert there.recorder.problem is None
    assert there.archive.span("axis1", ["R"], T0 - 1, None, None, "1 h").buckets.count.sum() == 1500
    there.recorder.close()


def test_a_server_that_is_not_there_is_told_and_tried_again(tmp_path: Path) -> None:
    world = World(Database(None, f"postgresql://nobody:secret@/none?host={tmp_path}"))
    world.run(3.0)
    problem = world.recorder.problem or ""
    assert "postgresql" in problem and "secret" not in problem and str(os.getpid()) not in problem


@pytest.mark.parametrize(
    ("url", "says"), [("mysql://x/y", "mysql is not known"), ("nonsense", "history.url"), ("oracle://x", "oracle")]
)
def test_another_database_is_refused(url: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        Database(None, url)
