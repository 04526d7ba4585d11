"""What the soak counts as lost, and what it says of the memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from benchmarks.soak.service import Service, Signs
from benchmarks.soak.tally import Quiet, Stretch, Tally, report


def quiet(
    time_s: float, behind: tuple[int, ...], *, full: int = 0, late_s: float = 0.0, memory_MB: float = 300.0
) -> Quiet:
    sent = tuple(round(1000 * time_s) for _ in behind)
    return Quiet(time_s, sent, behind, behind, behind, (full, *(0 for _ in behind[1:])), late_s, 0.0, memory_MB)


def stretch(last: Quiet, exempt: set[int] = frozenset()) -> Stretch:  # type: ignore[assignment]
    return Stretch("garbage", quiet(0.0, (5, 5)), last, exempt)


def test_lost_is_what_was_sent_whole_and_is_not_there() -> None:
    assert stretch(quiet(10.0, (5, 8))).lost == 3
    assert stretch(quiet(10.0, (5, 8)), exempt={1}).lost == 0, "its port was away"
    full = stretch(quiet(10.0, (90, 8), full=4))
    assert (full.lost, full.no_room, full.busy) == (3, 4, False), "a drive whose terminal ran over is told apart"
    assert stretch(quiet(10.0, (90, 5), full=4, late_s=0.7)).busy


@pytest.mark.parametrize("alike", [0.0, 0.8])
def test_the_memory_slope_has_an_interval_that_holds(alike: float) -> None:
    """95 % of 50 half hours, with pauses every 6 s and noise of 0.5 MB that may go on from one to the next."""
    rng, true_MB_h, hit, widths = np.random.default_rng(30), 3.0, 0, []
    for _ in range(50):
        memory, noise = [], 0.0
        for time_s in np.arange(0.0, 1800.0, 6.0):
            noise = alike * noise + float(rng.normal(0.0, 0.5 * np.sqrt(1 - alike**2)))
            memory.append(stretch(quiet(time_s, (5, 5), memory_MB=300 + true_MB_h * time_s / 3600 + noise)))
        found = Tally("tmpfs", stretches=memory).slope_MB_h()
        assert found is not None
        hit += abs(found[0] - true_MB_h) <= found[1]
        widths.append(found[1])
    assert hit >= 42 and np.median(widths) < (0.6 if alike == 0.0 else 2.0)


def test_a_short_run_says_that_it_cannot_show_a_slope() -> None:
    tally = Tally("tmpfs", stretches=[stretch(quiet(10.0, (5, 5)))], kills_s=[1.5], stops_s=[0.4])
    assert tally.slope_MB_h() is None
    assert "this length cannot show it" in report(tally) and "| good samples lost | 0 of 20,000 | 0 |" in report(tally)


def test_an_answer_from_memory_alone_is_no_lost_minute(tmp_path: Path) -> None:
    """A daemon that has just come back opens its database while it is asked."""

    class Program:
        answers = [  # noqa: RUF012
            {"time": [], "note": "the history is being opened"},
            {"time": ["1970-01-01T00:01:38Z", "1970-01-01T00:01:37Z"], "note": None},
        ]

        def get(self, _: str) -> Any:
            return self.answers.pop(0)

    service = Service(tmp_path / "c.toml", tmp_path, cast(Signs, None), tmp_path / "notify", {})
    service._program = cast(Any, Program())
    assert service.last_row_s("axis0", before_s=100.0) == 98.0
