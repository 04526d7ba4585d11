"""The watch for jumps: what it does with each tick, and what is told of a parameter that has stepped."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon import parameters
from servo_daemon.plant.build import build_plant
from servo_daemon.tracking.changes.jumps import Action, JumpWatch, Known, message

#: Whether a tick's innovations are beyond what the noise explains.
BAD, GOOD = True, False


def judged(watch: JumpWatch, *ticks: bool) -> list[Action]:
    return [watch.judge(unexplained) for unexplained in ticks]


# -- 2 bad ticks are undone, then 300 are learned from whatever they are ----------------------------------------------


def test_a_single_bad_tick_is_undone_and_forgotten() -> None:
    watch = JumpWatch()
    quiet = [watch.quiet]
    for unexplained in (BAD, GOOD, GOOD, GOOD, GOOD):  # a good tick counts a quarter
        assert judged(watch, unexplained) == ["undo" if unexplained else "learn"]
        quiet.append(watch.quiet)
    assert quiet == [True, False, False, False, False, True]


def test_a_bad_tick_counts_until_four_good_ones_are_over() -> None:
    assert judged(JumpWatch(), BAD, GOOD, BAD, BAD) == ["undo", "learn", "undo", "learn"]


@pytest.mark.parametrize("explained", [True, False])
def test_what_comes_is_sudden_only_after_samples_that_were_explained(explained: bool) -> None:
    watch = JumpWatch()
    for _ in range(20):
        watch.observe(unexplained=False, explained=explained)
        judged(watch, GOOD)
    for k in range(2):  # once it has come nothing is explained, whatever was before
        watch.observe(unexplained=True, explained=explained and k == 0)
        judged(watch, BAD)
        assert watch.sudden == explained


def test_what_goes_on_is_learned_from_for_half_a_minute() -> None:
    watch = JumpWatch()
    assert judged(watch, *[BAD] * 303) == ["undo", "undo", *["learn"] * 301]
    assert judged(watch, BAD, BAD, BAD) == ["undo", "undo", "learn"]


def test_while_a_step_is_looked_for_all_that_is_unexplained_is_undone() -> None:
    watch = JumpWatch()
    assert [watch.judge(BAD, searched=True) for _ in range(50)] == ["undo"] * 50
    assert judged(watch, BAD) == ["learn"], "once nothing was found"


def test_good_ticks_between_delay_it_by_a_quarter_each() -> None:
    """After bad, bad, good, bad: 1, 2, 1.75, 2.75."""
    assert judged(JumpWatch(), BAD, BAD, GOOD, BAD) == ["undo", "undo", "learn", "learn"]


def test_one_bad_tick_in_five_is_always_undone() -> None:
    assert judged(JumpWatch(), *[BAD, GOOD, GOOD, GOOD, GOOD] * 200) == ["undo", *["learn"] * 4] * 200


def test_reset_forgets_everything() -> None:
    watch = JumpWatch()
    judged(watch, *[BAD] * 30)
    watch.reset()  # the rest as well
    assert watch.quiet
    assert judged(watch, BAD, BAD, BAD) == ["undo", "undo", "learn"]


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
