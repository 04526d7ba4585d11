"""When a history is kept, and where."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from servo_daemon.config import HistoryConfig, parse_config
from servo_daemon.daemon.daemon import Daemon
from servo_daemon.daemon.recording import Recording
from servo_daemon.errors import ConfigError
from tests.fake_daemon import make_snapshot
from tests.unit.history.world import Drive


@pytest.mark.parametrize(
    ("history", "with_state", "where"),
    [
        ({}, True, "state/history.sqlite"),
        ({"path": "other.sqlite"}, True, "other.sqlite"),
        ({"path": "other.sqlite"}, False, "other.sqlite"),
        ({}, False, None),
        ({"enabled": False}, True, None),
    ],
)
def test_where_it_is_kept(history: dict[str, object], with_state: bool, where: str | None, tmp_path: Path) -> None:
    if "path" in history:
        history = {"path": str(tmp_path / str(history["path"]))}
    daemon = Daemon(parse_config({"history": history}), tmp_path / "state" if with_state else None)
    if where is None:
        assert daemon.archive is None
    else:
        assert daemon.archive is not None
        assert daemon.archive.recorder.database.path == tmp_path / where
        assert [source.name for source in daemon.archive.recorder.sources] == ["axis1"]


def test_two_places_and_impossible_ones_are_refused() -> None:
    with pytest.raises(ConfigError, match="path and url: give one of them"):
        parse_config({"history": {"path": "a", "url": "postgresql://b"}})
    with pytest.raises(ConfigError, match="mysql is not known"):
        Daemon(parse_config({"history": {"url": "mysql://a/b"}}))


def test_the_last_rows_are_written_at_a_stop(tmp_path: Path) -> None:
    drive = Drive()
    recording = Recording(HistoryConfig(), tmp_path, [drive])
    recording.start()
    drive.history.append(make_snapshot(time=time.time()))
    recording.stop(30.0)
    assert recording.recorder.counts.rows == 1 and recording.problem is None
