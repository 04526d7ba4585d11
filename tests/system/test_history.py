"""The history of the real program over SIGKILLs: what was there five seconds before is there afterwards."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from tests.system.harness import all_tracking, daemon, nominal_table, wait_for, write_config

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
