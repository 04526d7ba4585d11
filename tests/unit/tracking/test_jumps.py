"""The watch for jumps: what it does with each tick, and which parameters it names afterwards."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon import parameters
from servo_daemon.plant.build import build_plant
from servo_daemon.tracking.changes.jumps import Action, JumpWatch, Known, jumped, message

BAD, GOOD = (True, False), (False, True)
#: Neither beyond the noise nor as the noise has it: a filter that is still settling.
SO_SO = (False, False)


def judged(watch: JumpWatch, *ticks: tuple[bool, bool]) -> list[Action]:
    return [watch.judge(unexplained, settled) for unexplained, settled in ticks]


def opened() -> JumpWatch:
    watch = JumpWatch()
    judged(watch, BAD, BAD, BAD)
    assert watch.is_open
    return watch


# -- the state machine: 3 bad ticks open, 10 at least, 30 at most, 5 settled in a row accept, 300 of rest -----------


def test_a_single_bad_tick_is_undone_and_forgotten() -> None:
    watch = JumpWatch()
    assert watch.quiet
    assert judged(watch, BAD) == ["undo"]
    assert not watch.quiet and not watch.is_open
    assert judged(watch, GOOD, GOOD, GOOD) == ["learn"] * 3
    assert not watch.quiet  # a good tick counts a quarter
    assert judged(watch, GOOD) == ["learn"]
    assert watch.quiet
    assert judged(watch, BAD, BAD) == ["undo", "undo"], "the first one still counts"
    assert not watch.is_open


@pytest.mark.parametrize("explained", [True, False])
def test_what_comes_is_sudden_only_after_samples_that_were_explained(explained: bool) -> None:
    watch = JumpWatch()
    for _ in range(20):
        watch.observe(unexplained=False, explained=explained)
        judged(watch, GOOD)
    for k in range(3):  # once it has come nothing is explained, whatever was before
        watch.observe(unexplained=True, explained=explained and k == 0)
        judged(watch, BAD)
        assert watch.sudden == explained
    assert watch.is_open


def test_ticks_that_are_merely_not_settled_are_learned_from() -> None:
    watch = JumpWatch()
    assert judged(watch, *[SO_SO] * 50) == ["learn"] * 50
    assert watch.quiet


def test_three_bad_ticks_open() -> None:
    watch = JumpWatch()
    assert judged(watch, BAD, BAD, BAD) == ["undo", "undo", "open"]
    assert watch.is_open and not watch.quiet


def test_good_ticks_between_delay_the_opening_by_a_quarter_each() -> None:
    """3 after bad, bad, good, bad, bad: 1, 2, 1.75, 2.75, 3.75."""
    assert judged(JumpWatch(), BAD, BAD, GOOD, BAD, BAD) == ["undo", "undo", "learn", "undo", "open"]


def test_one_bad_tick_in_five_never_opens() -> None:
    watch = JumpWatch()
    assert "open" not in judged(watch, *[BAD, GOOD, GOOD, GOOD, GOOD] * 200)


def test_settled_ticks_accept_after_the_least_time() -> None:
    watch = opened()
    assert judged(watch, *[GOOD] * 10) == ["settle"] * 9 + ["accept"]
    assert not watch.is_open and watch.quiet
    assert judged(watch, BAD) == ["undo"], "after an accepted jump there is no rest"


def test_five_settled_ticks_in_a_row_are_needed() -> None:
    """Nine settled, one not: the tenth tick does not accept, five more do."""
    watch = opened()
    assert judged(watch, *[GOOD] * 9, SO_SO) == ["settle"] * 10
    assert judged(watch, *[GOOD] * 5) == ["settle"] * 4 + ["accept"]


def test_what_is_still_bad_while_open_is_settled_from_not_undone() -> None:
    """The parameters must move, so even bad ticks are learned from; they do not open it twice."""
    assert judged(opened(), *[BAD] * 12) == ["settle"] * 12


def test_settling_at_the_last_moment_still_accepts() -> None:
    assert judged(opened(), *[BAD] * 25, *[GOOD] * 5) == ["settle"] * 29 + ["accept"]


def test_never_settled_rejects_and_rests() -> None:
    watch = opened()
    assert judged(watch, *[BAD] * 30) == ["settle"] * 29 + ["reject"]
    assert not watch.is_open and watch.quiet
    assert judged(watch, *[BAD] * 300) == ["learn"] * 300
    assert judged(watch, BAD, BAD, BAD) == ["undo", "undo", "open"]


def test_four_settled_ticks_in_a_row_are_never_enough() -> None:
    """Four of five, thirty ticks long: a model that nearly fits is no jump."""
    assert judged(opened(), *[GOOD, GOOD, GOOD, GOOD, SO_SO] * 6) == ["settle"] * 29 + ["reject"]


def test_reset_forgets_everything() -> None:
    watch = opened()
    judged(watch, *[BAD] * 30)
    watch.reset()  # the rest as well
    assert watch.quiet
    assert judged(watch, BAD, BAD, BAD) == ["undo", "undo", "open"]
    watch.reset()
    assert not watch.is_open and judged(watch, GOOD) == ["learn"]


# -- which parameters jumped ------------------------------------------------------------------------------------

NAMES = ("R", "K", "J")


def named(
    moved: tuple[float, float, float],
    *,
    before_std: float = 0.003,
    after_std: float = 0.004,
    scales: tuple[float, float, float] = (1.0, 1.0, 1.0),
    candidates: tuple[bool, bool, bool] = (True, True, True),
) -> list[str]:
    """`jumped` from arbitrary coordinates; before and after together are known to 5e-3 where nothing is said."""
    start = np.array([-0.7, -1.2, -4.6])
    before = Known(NAMES, start, before_std**2 * np.eye(3), 10.0)
    after = start + np.array(moved)
    found = jumped(before, after, np.full(3, after_std), np.array(scales), np.array(candidates))
    return [NAMES[k] for k in found]


def test_nothing_moved_names_nothing() -> None:
    assert named((0.0, 0.0, 0.0)) == []


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_move_within_six_standard_deviations_is_none(sign: float) -> None:
    """Before and after add up: √(0.003² + 0.004²) = 0.005, six of them 0.030, which is noticeable."""
    assert named((sign * 0.0299, 0.0, 0.0)) == []
    assert named((sign * 0.0301, 0.0, 0.0)) == ["R"]


def test_both_spreads_count() -> None:
    """0.15 is 5 σ of either spread, before or after, and 15 σ of the other alone."""
    assert named((0.15, 0.0, 0.0), before_std=0.03, after_std=0.01) == []
    assert named((0.15, 0.0, 0.0), before_std=0.01, after_std=0.03) == []
    assert named((0.15, 0.0, 0.0), before_std=0.01, after_std=0.01) == ["R"]


def test_a_move_that_nobody_would_notice_is_none_however_significant() -> None:
    """2 % of the coordinate's unit: 1 for a logarithm, the typical torque for a load."""
    assert named((0.019, 0.0, 0.0), before_std=1e-5, after_std=1e-5) == []
    assert named((0.021, 0.0, 0.0), before_std=1e-5, after_std=1e-5) == ["R"]
    assert named((0.19, 0.0, 0.0), before_std=1e-5, after_std=1e-5, scales=(10.0, 1.0, 1.0)) == []
    assert named((0.21, 0.0, 0.0), before_std=1e-5, after_std=1e-5, scales=(10.0, 1.0, 1.0)) == ["R"]


def test_what_was_pulled_along_is_not_named() -> None:
    """K moved by 13 standard deviations, J by 9: significant, but less than 0.3 of R's 50."""
    assert named((0.25, 0.065, -0.045)) == ["R"]


def test_two_that_jumped_are_both_named_the_more_significant_first() -> None:
    assert named((0.10, 0.0, -0.25)) == ["J", "R"]


def test_only_candidates_are_named_and_others_hide_nobody() -> None:
    """K is none and moved by 100 standard deviations: R's 10 are still R's."""
    assert named((0.05, 0.5, 0.0), candidates=(True, False, True)) == ["R"]
    assert named((0.05, 0.5, 0.0), candidates=(False, False, False)) == []


def test_what_is_too_small_to_notice_hides_nobody() -> None:
    """K's move is the most significant by far, but no jump: the larger and less certain one of R is named."""
    before = Known(NAMES, np.zeros(3), np.diag([0.005, 1e-5, 0.005]) ** 2, 0.0)
    after, std = np.array([0.25, 0.019, 0.0]), np.array([0.0, 0.0, 0.0])
    assert jumped(before, after, std, np.ones(3), np.ones(3, dtype=bool)) == [0]


# -- the event ----------------------------------------------------------------------------------------------------


def test_message_of_a_positive_parameter() -> None:
    before = Known(("L", "R"), np.log([1e-3, 0.5]), np.eye(2), 12.3)
    kind, text, data = message(parameters.R, before, float(np.log(0.65)), 13.7)
    assert kind == "parameter_jump"
    assert text == "R stepped from 0.5 to 0.65 Ω (+30.0 %)"
    assert data == {
        "parameter": "R",
        "unit": "Ω",
        "from": pytest.approx(0.5),
        "to": pytest.approx(0.65),
        "time_s": 12.3,
        "recognised_s": 13.7,
    }


def test_message_of_a_fall() -> None:
    before = Known(("J",), np.log([0.01]), np.eye(1), 0.0)
    assert (
        message(parameters.J, before, float(np.log(0.0075)), 1.0)[1] == "J stepped from 0.01 to 0.0075 kg·m² (-25.0 %)"
    )


def test_message_of_a_signed_parameter_has_no_percentage() -> None:
    """A load torque steps from nothing: its size is a torque."""
    TL = next(p for p in build_plant(("constant_load_torque",)).parameters if p.name == "TL")
    before = Known(("R", "TL"), np.array([0.0, 0.0]), np.eye(2), 4.0)
    _, text, data = message(TL, before, -1.378, 5.0)
    assert text == "TL stepped from 0 to -1.378 N·m (-1.38 N·m)"
    assert (data["from"], data["to"], data["unit"]) == (0.0, -1.378, "N·m")
