"""The history of the real program over SIGKILLs: what was there five seconds before is there afterwards."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from datetime import datetime
from pathlib import Path

import pytest

from tests.system.harness import ROOT, all_tracking, daemon, environment, nominal_table, wait_for, write_config

#: What issue 29 allows to be lost.
_LOST_S = 5.0


@pytest.mark.slow
def test_a_killed_daemon_begins_where_it_ended(tmp_path: Path) -> None:
    config = write_config(tmp_path / "c.toml", f"{nominal_table()}[drive.options]\nseed = 1")
    state = tmp_path / "state"
    with daemon("--config", config, "--state-dir", state) as program:
        program.until(all_tracking, "tracks")
        began = program.get("/health")["started"]
        kept = wait_for(
            lambda: (d := program.get(f"/drives/axis1/history?parameter=R&start={began}"))["points"] > 60 and d,
            "rows are there",
        )
        time.sleep(_LOST_S)  # what is older than this must survive
        program.send(signal.SIGKILL)
        program.wait()
    with daemon("--config", config, "--state-dir", state) as program:
        program.until(lambda d: d["samples"] > 0, "runs again")
        document = program.get(f"/drives/axis1/history?parameter=R&start={began}&points=20000")
        assert document["level"] == "rows" and set(kept["time"]) <= set(document["time"])
        found = dict(zip(document["time"], zip(document["value"], document["std"], strict=True), strict=True))
        for moment, value, std in zip(kept["time"], kept["value"], kept["std"], strict=True):
            if std is not None:
                assert found[moment][0] == pytest.approx(value, abs=std / 16), moment
        kinds = [e["kind"] for e in program.get("/drives/axis1/events")["events"]]
        assert kinds.count("connected") == 2 and kinds.index("filter_started") < len(kinds) - 1 - kinds[::-1].index(
            "connected"
        )
        assert program.get("/drives/axis1/history?parameter=R,K&window=1y&level=1%20h")["points"] in {1, 2}
        assert program.get("/health")["status"] == "ok"


_WRITER = """
import sys, time
from pathlib import Path
from servo_daemon.config import HistoryConfig
from servo_daemon.daemon.recording import Recording
from tests.fake_daemon import make_snapshot
from tests.unit.history.world import Drive
drive = Drive()
recording = Recording(HistoryConfig(), Path(sys.argv[1]), [drive])
recording.start()
while True:
    time.sleep(0.1)
    drive.history.append(make_snapshot(time=time.time()))
    print(time.time(), flush=True)
"""


@pytest.mark.slow
def test_whenever_it_is_killed_at_most_five_seconds_are_lost(tmp_path: Path) -> None:
    """Four writers at once, each killed at another moment between two turns."""
    folders = [tmp_path / str(k) for k in range(4)]
    writers = [
        subprocess.Popen(
            [sys.executable, "-c", _WRITER, folder], cwd=ROOT, env=environment(), stdout=subprocess.PIPE, text=True
        )
        for folder in folders
    ]
    last: list[float] = []
    try:
        for writer in writers:
            assert writer.stdout is not None
            assert writer.stdout.readline(), "runs"
        time.sleep(4.0)
        for writer in writers:
            time.sleep(0.8)  # a quarter of a turn
            writer.kill()
            last.append(max(float(line) for line in writer.communicate()[0].split()))
    finally:
        for writer in writers:
            writer.kill()
            writer.communicate()
    for folder, end in zip(folders, last, strict=True):
        with closing(sqlite3.connect(folder / "history.sqlite")) as file:
            assert file.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            written = file.execute("SELECT max(stop) FROM block").fetchone()[0]
        assert written is not None and end - written <= _LOST_S, datetime.fromtimestamp(end)
