"""What was published, after hours, restarts and steps of the clock, against what was published."""

from __future__ import annotations

import sqlite3
import threading
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from servo_daemon.config import HistoryConfig
from servo_daemon.history.database import Database
from servo_daemon.history.levels import choose, levels_of
from servo_daemon.history.tables import BLOCK, NewerSchemaError, ensure_schema
from tests.fake_daemon import T0
from tests.unit.history.world import Drive, World


@pytest.fixture(scope="module")
def half_an_hour(tmp_path_factory: pytest.TempPathFactory) -> World:
    """25 minutes, killed after 12 of them, and the last seconds still in memory."""
    world = World.in_folder(tmp_path_factory.mktemp("store"))
    world.run(720.0)
    world.restart()
    world.run(780.0)
    world.run(2.0, turns=False)
    return world


def _expected(world: World, period_s: float) -> dict[float, np.ndarray]:
    out: dict[float, list[float]] = {}
    for time, value in world.truth.items():
        out.setdefault(np.floor(time / period_s + 1e-6) * period_s, []).append(value)
    return {time: np.array(values) for time, values in out.items()}


@pytest.mark.parametrize(("level", "period_s"), [("1 s", 1.0), ("1 min", 60.0), ("1 h", 3600.0)])
def test_every_level_holds_every_row_once(half_an_hour: World, level: str, period_s: float) -> None:
    world = half_an_hour
    span = world.archive.span("axis1", ["R"], T0 - 10, None, None, level)
    expected = _expected(world, period_s)
    assert span.buckets.time_s.tolist() == sorted(expected)
    for k, time in enumerate(span.buckets.time_s):
        values = expected[time]
        b = span.buckets
        assert b.count[k, 0] == len(values) == b.status[k, 0].sum()
        assert b.mean[k, 0] == pytest.approx(values.mean(), abs=0.01 / 16)
        assert b.low[k, 0] == pytest.approx(values.min(), abs=0.01 / 8) and b.low[k, 0] <= values.min() + 1e-9
        assert b.high[k, 0] == pytest.approx(values.max(), abs=0.01 / 8)


def test_single_rows_are_there_with_state_and_truth(half_an_hour: World) -> None:
    span = half_an_hour.archive.span("axis1", None, T0, None, None, "rows")
    assert len(span.buckets) == 15_020
    assert {"R", "current_A", "velocity_rad_s", "R_true"} <= set(span.buckets.names)
    assert set(half_an_hour.archive.names("axis1")) == set(span.buckets.names)


def test_the_bucket_in_which_a_span_ends_is_whole(half_an_hour: World) -> None:
    for end in (T0 + 1441.0, T0 + 661.0):  # in blocks that are open and packed
        minutes = half_an_hour.archive.span("axis1", ["R"], end - 100, end, None, "1 min").buckets
        assert minutes.time_s.tolist() == [end - 121, end - 61, end - 1] and set(minutes.count[:, 0]) == {600}


def test_few_points_hold_all_that_was_there(half_an_hour: World) -> None:
    span = half_an_hour.archive.span("axis1", ["R"], T0, None, 40, "1 s")
    assert 20 <= len(span.buckets) <= 40
    assert span.buckets.count.sum() == 15_020


def test_the_latest_seconds_come_from_memory(half_an_hour: World) -> None:
    world = half_an_hour
    with world.recorder.engine.connect() as connection:  # type: ignore[union-attr]
        written = connection.scalar(sa.select(sa.func.max(BLOCK.c.stop)))
    span = world.archive.span("axis1", ["R"], world.now - 5, None, None, "rows")
    assert written < world.now - 1.5 and span.buckets.time_s[-1] == pytest.approx(world.now, abs=1e-3)


def test_nobody_asks_for_what_never_was(half_an_hour: World) -> None:
    assert len(half_an_hour.archive.span("axis1", ["Tc"], T0, None, 500).buckets.names) == 0
    with pytest.raises(ValueError, match="1 min"):
        half_an_hour.archive.span("axis1", ["R"], T0, None, 500, "2 h")


def test_a_clock_set_back_never_shows_the_future(tmp_path: Path) -> None:
    world = World.in_folder(tmp_path)
    world.run(130.0)
    world.now += 10_000.0  # the clock was ahead …
    world.run(130.0)
    world.now -= 10_200.03  # … and is set right
    world.run(70.0)
    for level in ("rows", "1 s", "1 min"):
        buckets = world.archive.span("axis1", ["R"], T0 - 1000, None, None, level).buckets
        assert np.all(np.diff(buckets.time_s) >= 0) and buckets.time_s[-1] <= world.now
        seen = [v for t, v in world.truth.items() if t <= world.now]
        # Half of a minute that both clocks have seen may lie beyond now.
        assert len(seen) <= buckets.count.sum() <= len(seen) + (600 if level == "1 min" else 10)
    world.now += 20_000.0  # when that time has really come, it is there
    assert world.archive.span("axis1", ["R"], T0 - 1000, None, None, "1 min").buckets.count.sum() == 3300


def test_events_and_documents_stay_for_good(tmp_path: Path) -> None:
    world = World.in_folder(tmp_path)
    log = world.drives[0].log
    for k in range(5):
        log.add("alarm" if k % 2 else "refreshed", f"event {k}", {"value": float("nan") if k == 1 else k})
    world.row(world.drives[0], 0.1)
    world.now = T0 * 1e3  # events carry the real clock's time
    world.turn()
    world.diagnose({"verdict": "none", "effects": []})
    world.drives[0].model = ("coulomb_friction",)
    world.turn()
    world.turn()
    diagnosis = world.drives[0].diagnosis
    world.restart()
    world.drives[0].log.add("connected", "here again")
    world.drives[0].diagnosis = diagnosis  # read from its folder …
    world.turn()
    world.drives[0].model = ("coulomb_friction",)  # … and restored, before the first row
    world.row(world.drives[0], 0.1)
    world.turn()
    page = world.archive.events("axis1", [], None, 3, None)
    assert [e.message for e in page.events] == ["event 3", "event 4", "here again"]
    older = world.archive.events("axis1", [], None, 3, page.next)
    assert [e.message for e in older.events] == ["event 0", "event 1", "event 2"] and older.next is None
    assert older.events[1].data == {"value": None}
    assert [e.kind for e in world.archive.events("axis1", ["alarm"], None, 10, None).events] == ["alarm"] * 2
    later = world.archive.events("axis1", [], page.events[-1].time, 10, None)
    assert [e.message for e in later.events] == ["here again"]
    assert [d.body["result"] for d in world.archive.documents("axis1", "diagnosis", 9)] == [
        {"verdict": "none", "effects": []}
    ]
    assert [d.body["effects"] for d in world.archive.documents("axis1", "model", 9)] == [["coulomb_friction"]]
    (kept,) = world.archive.documents("axis1", "diagnosis", 9)
    assert world.archive.document("axis1", "diagnosis", kept.number) == kept
    assert world.archive.document("axis1", "model", kept.number) is None


def test_the_level_that_suits() -> None:
    levels = levels_of(HistoryConfig())
    now = 1e9
    assert choose(levels, now - 60, now, 500, now).name == "rows"
    assert choose(levels, now - 3000, now, 500, now).name == "1 s"
    assert choose(levels, now - 7200, now, 50_000, now).name == "1 s"
    assert choose(levels, now - 86_000, now, 500, now).name == "1 min"
    assert choose(levels, now - 365 * 86_400, now, 500, now).name == "1 h"
    assert choose(levels, now - 50 * 365 * 86_400, now, 500, now).name == "1 h"


def test_old_rows_go_once_the_clock_is_proven(tmp_path: Path) -> None:
    world = World.in_folder(tmp_path, rows_hours=0.1)
    world.run(200.0)
    world.now += 50_000.0  # a clock that was wrong at the start, or is now: who knows
    world.run(63.0)
    assert len(world.archive.span("axis1", ["R"], T0, None, None, "rows").buckets) == 2630
    world.now, world.monotonic = world.now + 3700.0, world.monotonic + 3700.0
    world.run(63.0)
    rows = world.archive.span("axis1", ["R"], T0, None, None, "rows").buckets
    assert rows.time_s[0] > T0 + 50_000 and len(rows) == 630
    assert world.archive.span("axis1", ["R"], T0, None, None, "1 min").buckets.count.sum() == 3260


def test_over_the_quota_the_oldest_of_the_largest_level_goes(tmp_path: Path) -> None:
    world = World.in_folder(tmp_path)
    world.run(400.0)
    events = world.drives[0].log
    events.add("alarm", "kept")
    world.turn()
    world.recorder.quota_bytes = 0.0
    world.run(63.0)
    first = world.archive.span("axis1", ["R"], T0, None, None, "rows").buckets.time_s[0]
    assert first > T0 + 300
    world.now = T0 * 1e3
    assert world.archive.events("axis1", ["alarm"], None, 9, None).events[0].message == "kept"


def test_an_older_schema_is_brought_up_to_date_and_a_newer_left_alone() -> None:
    engine = sa.create_engine("sqlite://")
    with engine.begin() as connection:
        ensure_schema(connection, ())
        add = "ALTER TABLE event ADD COLUMN severity INTEGER NOT NULL DEFAULT 0"
        ensure_schema(connection, (lambda c: c.execute(sa.text(add)),))  # type: ignore[arg-type, return-value]
        assert connection.execute(sa.text("SELECT severity FROM event")).all() == []
        assert connection.scalar(sa.text("SELECT value FROM meta WHERE key = 'schema'")) == "2"
        with pytest.raises(NewerSchemaError, match="schema is 2"):
            ensure_schema(connection, ())


def test_a_commit_waits_for_no_checkpoint(tmp_path: Path) -> None:
    """What is committed stays in the log until the writer, in a moment in which nobody waits for it, brings it over."""
    world = World.in_folder(tmp_path)
    world.turn()
    assert world.database.path is not None
    sizes: list[int] = []
    for _ in range(7):
        world.run(30.0)
        sizes.append(world.database.path.stat().st_size)
    assert sizes[0] == sizes[1] < sizes[3], sizes
    with closing(sqlite3.connect(world.database.path)) as connection:
        assert connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()[1] < 100, "the log began anew"


def test_who_asks_while_the_database_is_being_opened_gets_what_is_in_it(tmp_path: Path) -> None:
    """As a client that asks a daemon which has just come back what the kill has cost."""
    world = World.in_folder(tmp_path)
    world.run(30.0)
    world.drives, world.database = (Drive(),), Database(tmp_path / "history.sqlite")
    world.recorder = world.new_recorder()

    class Begun(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            world.turn()  # the writer's, meanwhile
            return super().wait(timeout)

    world.recorder.begun = Begun()
    assert len(world.archive.span("axis1", ["R"], T0, None, None, "rows").buckets) == 300
