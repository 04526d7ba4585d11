"""When a diagnosis is due by itself: unexplained for long, seen for long, and not again and again."""

from __future__ import annotations

import pytest

from servo_daemon.pipeline.diagnosis_watch import MismatchWatch
from tests.fake_daemon import make_estimate


class Clock:
    """Estimates ten times a second over a ring of 60 s that fills up."""

    def __init__(self, watch: MismatchWatch, ring_s: float = 60.0) -> None:
        self.watch, self.ring_s, self.now_s = watch, ring_s, 0.0

    def run(self, seconds: float, white: bool | None, step_s: float = 0.1) -> float | None:
        """When it was due, s; None: never."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += step_s
            estimate = make_estimate(self.now_s, health={"innovation_white": white})
            if self.watch.due(estimate, min(self.now_s, self.ring_s), self.now_s):
                return self.now_s
        return None


@pytest.fixture
def clock() -> Clock:
    return Clock(MismatchWatch(60.0))


def test_a_model_that_never_fitted_is_due_when_the_ring_is_full(clock: Clock) -> None:
    assert clock.run(100.0, False) == pytest.approx(54.0, abs=0.3)


def test_a_model_that_fits_no_longer_is_due_when_half_of_the_ring_is_of_it(clock: Clock) -> None:
    assert clock.run(300.0, True) is None
    assert clock.run(100.0, False) == pytest.approx(330.0, abs=0.3)


def test_moments_do_not_count(clock: Clock) -> None:
    for _ in range(40):
        assert clock.run(20.0, False) is None
        assert clock.run(25.0, True) is None


def test_a_flag_that_flickers_counts_by_its_share(clock: Clock) -> None:
    clock.run(60.0, True)
    due = [clock.run(s, white) for _ in range(20) for s, white in ((9.0, False), (1.0, True))]
    assert next(t for t in due if t is not None) < 110.0


def test_before_the_filter_runs_nothing_is_judged(clock: Clock) -> None:
    assert clock.run(200.0, None) is None


def test_the_same_finding_makes_the_pauses_longer(clock: Clock) -> None:
    pauses = []
    for finding in (("found", "a"), ("found", "a"), ("found", "a"), ("found", "a"), ("none",), ("none",)):
        assert clock.run(0.2, False) is not None or clock.run(60.0, False) is not None
        clock.watch.ended(finding, clock.now_s)
        began = clock.now_s
        due = clock.run(100_000.0, False, step_s=60.0)
        assert due is not None
        pauses.append(round((due - began) / 60))
    assert pauses == [15, 60, 240, 960, 15, 60]


def test_another_model_is_a_new_question(clock: Clock) -> None:
    clock.run(60.0, False)
    clock.watch.ended(("found", "a"), clock.now_s)
    clock.watch.forget()
    assert clock.run(100.0, False) == pytest.approx(54.1 + 30.0, abs=0.5)


def test_without_a_ring_there_is_nothing_to_diagnose() -> None:
    assert Clock(MismatchWatch(0.0), 0.0).run(200.0, False) is None
