"""A store that is out of reach, full or broken: said once, made good from memory, and nothing is ever wrong."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from servo_daemon.history import database
from servo_daemon.published.archive import ArchiveUnavailableError
from servo_daemon.published.history import HistoryRing
from tests.fake_daemon import T0
from tests.unit.history.world import World


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "BUSY_S", 0.01)


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    made = World.in_folder(tmp_path)
    made.run(90.0)
    yield made
    made.recorder.close()


def rows_of(world: World) -> int:
    return len(world.archive.span("axis1", ["R"], T0 - 1, None, None, "rows").buckets)


def _file(world: World) -> Path:
    assert world.database.path is not None
    return world.database.path


def test_a_locked_database_is_waited_for(world: World, caplog: pytest.LogCaptureFixture) -> None:
    with closing(sqlite3.connect(_file(world))) as other:
        other.execute("BEGIN IMMEDIATE")
        with caplog.at_level(logging.WARNING):
            world.run(60.0)
        assert "locked" in (world.recorder.problem or "")
        assert len(caplog.records) == 1, "said once"
        other.rollback()
    world.run(9.0)
    assert world.recorder.problem is None and world.recorder.counts.rows_dropped == 0
    assert rows_of(world) == 1590
    minutes = world.archive.span("axis1", ["R"], T0 - 1, None, None, "1 min").buckets
    assert minutes.count[:, 0].tolist() == [599, 600, 391]  # the first row is 0.15 s after the minute


def test_what_memory_has_forgotten_meanwhile_is_counted(tmp_path: Path) -> None:
    world = World.in_folder(tmp_path / "later")
    world.drives[0].history = HistoryRing(capacity=500)
    (tmp_path / "later").write_text("in the way")  # as a file system that is not mounted yet
    world.run(80.0)
    assert world.recorder.problem is not None and str(tmp_path) in world.recorder.problem
    with pytest.raises(ArchiveUnavailableError, match="cannot be written"):
        rows_of(world)
    (tmp_path / "later").unlink()
    world.run(9.0)
    assert world.recorder.problem is None
    assert world.recorder.counts.rows_dropped + rows_of(world) == 890
    assert 300 <= world.recorder.counts.rows_dropped <= 400


def test_a_full_disk(world: World) -> None:
    engine = world.recorder.engine
    assert engine is not None
    full = [True]

    @sa.event.listens_for(engine, "checkout")
    def limit(connection: sqlite3.Connection, *_: object) -> None:
        pages = connection.execute("PRAGMA page_count").fetchone()[0] if full[0] else 1_000_000
        connection.execute(f"PRAGMA max_page_count = {pages}")

    world.run(130.0)
    assert "full" in (world.recorder.problem or "")
    assert rows_of(world) == 2200, "reading goes on, with what waits in memory"
    full[0] = False
    world.run(9.0)
    assert world.recorder.problem is None and rows_of(world) == 2290


def test_a_read_only_file(world: World, tmp_path: Path) -> None:
    """Root may write anything: SQLite is told to treat it as read-only."""
    engine = world.recorder.engine
    assert engine is not None
    read_only = [True]

    @sa.event.listens_for(engine, "checkout")
    def limit(connection: sqlite3.Connection, *_: object) -> None:
        connection.execute(f"PRAGMA query_only = {int(read_only[0])}")

    world.run(30.0)
    assert "readonly" in (world.recorder.problem or "")
    read_only[0] = False
    world.run(9.0)
    assert rows_of(world) == 1290


@pytest.mark.parametrize("while_running", [True, False])
@pytest.mark.parametrize("damage", ["header", "middle"])
def test_a_broken_file_is_set_aside_and_what_can_be_read_is_saved(
    world: World, while_running: bool, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    world.drives[0].log.add("alarm", "kept for good")
    world.turn()
    path = _file(world)
    with closing(sqlite3.connect(path)) as other:
        other.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    if not while_running:
        world.recorder.close()
    data = bytearray(path.read_bytes())
    at = 0 if damage == "header" else len(data) * 6 // 10
    data[at : at + 4096] = b"\xa5" * 4096
    path.write_bytes(bytes(data))
    with caplog.at_level(logging.WARNING):
        if while_running:
            world.database.close()  # pages in the cache of an open connection would hide the damage
            world.run(75.0)
        else:
            world.restart()
            world.run(75.0)
    assert world.recorder.problem is None
    bad = path.with_name("history.sqlite.bad")
    if damage == "middle" and not bad.exists():  # a page of a block that was not read again: found at the next start
        world.restart()
    assert bad.read_bytes()[at : at + 4096] == b"\xa5" * 4096
    assert any("set aside" in r.message for r in caplog.records)
    buckets = world.archive.span("axis1", ["R"], T0 - 1, None, None, "rows").buckets
    for time, value in zip(buckets.time_s, buckets.mean[:, 0], strict=True):
        assert value == pytest.approx(world.truth[round(float(time), 3)], abs=0.01 / 16)
    assert len(buckets) >= 740
    if damage == "middle":
        world.now = T0 * 1e3
        assert [e.message for e in world.archive.events("axis1", ["alarm"], None, 5, None).events] == ["kept for good"]
        assert len(buckets) > 750, "nothing was saved"


def test_a_file_that_was_deleted_is_begun_again(world: World) -> None:
    _file(world).unlink()
    world.run(9.0)
    assert _file(world).exists() and world.recorder.problem is None
    assert rows_of(world) == 90


def test_a_damaged_block_is_left_out(world: World) -> None:
    engine = world.recorder.engine
    assert engine is not None
    with engine.begin() as connection:
        connection.execute(sa.text("UPDATE block SET data = x'00112233' WHERE id = (SELECT min(id) FROM block)"))
    remaining = rows_of(world)
    assert 0 < remaining < 900
    world.run(60.0)
    assert world.recorder.problem is None and rows_of(world) == remaining + 600


def test_no_turn_ever_raises(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        world.recorder._blocks, "add", lambda *_: (_ for _ in ()).throw(OSError(5, "Input/output error"))
    )
    world.run(9.0)
    assert "Input/output error" in (world.recorder.problem or "")
    monkeypatch.undo()
    world.run(9.0)
    assert world.recorder.problem is None and rows_of(world) == 1080
    assert np.all(np.diff(world.archive.span("axis1", ["R"], T0 - 1, None, None, "rows").buckets.time_s) > 0)


def test_rows_do_not_wait_until_the_file_is_looked_through(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two gigabytes on a slow card take longer than the history that a kill may cost."""
    world.recorder.close()
    looked_through, begun = threading.Event(), threading.Event()

    def damage(_: database.Database) -> str | None:
        begun.set()
        assert looked_through.wait(60.0)
        return None

    monkeypatch.setattr(database.Database, "damage", damage)
    world.database = database.Database(_file(world))
    world.recorder = world.new_recorder()
    world.run(3.0)
    assert begun.wait(60.0)
    world.run(3.0)
    with closing(sqlite3.connect(_file(world))) as other:
        (newest,) = other.execute("SELECT max(stop) FROM block").fetchone()
    looked_through.set()
    assert newest == pytest.approx(world.now, abs=0.01)


def test_what_was_locked_is_written_in_the_next_turn(world: World) -> None:
    with closing(sqlite3.connect(_file(world))) as other:
        other.execute("BEGIN IMMEDIATE")
        world.run(3.0)
        assert world.recorder.problem is not None
        other.rollback()
    world.run(3.0)
    with closing(sqlite3.connect(_file(world))) as other:
        (newest,) = other.execute("SELECT max(stop) FROM block").fetchone()
    assert newest == pytest.approx(world.now, abs=0.01)
