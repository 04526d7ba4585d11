"""Eight drives on one daemon with every fault of `benchmarks/soak` once: nothing that was sent whole is lost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.soak.run import Plan, soak
from benchmarks.soak.tally import report

#: What issue 29 allows a kill to cost of the history, s.
HISTORY_S = 5.0
#: After which systemd takes the daemon for hung (WatchdogSec in deploy/), s: a machine with other work may need more
#: than the two seconds that the benchmark measures against.
HUNG_S = 10.0
#: Long enough to be killed while it stops on a machine with other work; the benchmark measures against 2 s.
STOP_S = 10.0


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_every_fault_once(program: Callable[..., str], tmp_path: Path) -> None:
    for part in (("mosquitto", "/usr/sbin/mosquitto"), ("gcc", "cc")):
        program(*part)
    tally = soak(tmp_path, Plan(rounds=1, lives=2, hurt_s=1.0, life_s=1.0), say=print)
    print(report(tally))  # shown with a failure
    assert not tally.left_out and len(tally.stretches) == 9 + 2
    assert tally.lost == 0 and tally.rows_dropped == 0
    for stretch in tally.stretches:
        counts = zip(stretch.by_drive("told"), stretch.by_drive("no_room"), strict=True)
        assert not any(told for told, full in counts if not full), stretch
    assert (list(tally.corrupt), list(tally.faults), tally.wrong) == ([], [], 0)
    assert len(tally.kills_s) == 2 and max(tally.kills_s) <= HISTORY_S
    assert max(tally.stops_s) < STOP_S and tally.gap_s < HUNG_S
