"""What the last windows say together, and which of the filter's values the balances refute."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servo_daemon.learning.examples.drawing import CORE
from servo_daemon.learning.features.window import Window, prepare
from servo_daemon.learning.refresh.champion_challenger import ChampionChallengerTest
from servo_daemon.learning.refresh.recent import Recent
from servo_daemon.simulate import PAPER_MOTOR, SimulatedDrive, make_settings

ALL = frozenset({*CORE, "Tc"})


def said(recent: Recent, time_s: float, factor: float, share: float) -> None:
    """A window that takes every parameter for `factor` times its true value, known to this share."""
    value = {n: factor * v for n, v in PAPER_MOTOR.items()} | {"Tc": 0.01}
    recent.add(time_s, value, {n: share * v for n, v in value.items()})


def told(recent: Recent, now_s: float, name: str = "J") -> tuple[float, float]:
    """As shares of the true value."""
    found = recent.of(name, now_s)
    assert found is not None
    return found[0] / PAPER_MOTOR[name], found[1] / PAPER_MOTOR[name]


def test_one_window_says_what_it_said() -> None:
    recent = Recent(12.5)
    assert recent.of("R", 0.0) is None
    said(recent, 5.0, 1.1, 0.04)
    value, std = told(recent, 5.0)
    assert value == pytest.approx(1.1)
    assert std == pytest.approx(0.044)
    assert recent.of("Tc", 5.0) == pytest.approx((0.01, 0.0004))


def test_windows_count_by_what_they_know_and_are_together_no_surer_than_the_surest() -> None:
    recent = Recent(12.5)
    said(recent, 5.0, math.exp(0.03), 0.04)
    said(recent, 10.0, math.exp(-0.06), 0.08)
    value, std = told(recent, 10.0)
    weight = np.array([0.04, 0.08]) ** -2.0
    assert math.log(value) == pytest.approx(weight @ [0.03, -0.06] / weight.sum())
    # They scatter by (0.09)² / (0.04² + 0.08²) = 1.01 of what they should: Birge's ratio.
    assert std / value == pytest.approx(0.04 * math.sqrt(0.09**2 / (0.04**2 + 0.08**2)))


def test_windows_that_agree_better_than_they_claim_do_not_make_it_surer() -> None:
    recent = Recent(12.5)
    for k in range(3):
        said(recent, 4.0 * k, 1.0, 0.05)
    assert told(recent, 8.0) == pytest.approx((1.0, 0.05))


def test_a_window_counts_no_more_when_it_is_old() -> None:
    recent = Recent(12.5)
    said(recent, 5.0, 1.0, 0.02)
    said(recent, 10.0, 1.02, 0.02)
    assert told(recent, 17.0)[0] == pytest.approx(1.01, abs=1e-3)
    assert told(recent, 18.0)[0] == pytest.approx(1.02)
    assert recent.of("J", 23.0) is None


def test_what_contradicts_the_newest_window_is_of_another_motor() -> None:
    recent = Recent(60.0)
    for k, factor in enumerate((1.0, 1.0, 1.3, 1.31)):
        said(recent, 5.0 * k, factor, 0.02)
    assert told(recent, 15.0)[0] == pytest.approx(1.305, abs=1e-3)
    recent.forget()
    assert recent.of("J", 15.0) is None


@pytest.fixture(scope="module")
def window() -> Window:
    """Of a motor with a dry friction of 8 % of its working torque."""
    friction = {"coulomb_friction": {"Tc": 0.08 * 0.30628 * 15.0}}
    return prepare(SimulatedDrive(make_settings(rate_hz=500.0, effects=friction)).next_block(2500))


def believed(**factors: float) -> dict[str, float]:
    return {n: v * factors.get(n, 1.0) for n, v in PAPER_MOTOR.items()}


@pytest.mark.parametrize(
    ("then", "now", "refuted"),
    [
        ({"J": 1.5, "B": 1.5}, {"J": 1.5, "B": 1.5}, {"J", "B", "Tc"}),
        ({"R": 1.3}, {"R": 1.3}, ALL),
        ({"K": 1.3, "J": 1.3, "B": 1.3}, {"K": 1.3, "J": 1.3, "B": 1.3}, ALL),
        ({"J": 1.5, "B": 1.5, "R": 1.3}, {"J": 1.5, "B": 1.5}, {"J", "B", "Tc"}),
        ({"R": 1.3}, {}, set()),
        ({}, {"R": 1.3}, set()),
        ({}, {}, set()),
    ],
    ids=[
        "the shaft's balance",
        "the armature's",
        "K wrong, and the shaft's with it",
        "R has been found meanwhile",
        "all found meanwhile",
        "right a window ago",
        "right",
    ],
)
def test_each_balance_refutes_what_is_in_it(
    window: Window, then: dict[str, float], now: dict[str, float], refuted: set[str]
) -> None:
    challenge = ChampionChallengerTest()
    challenge.believe(believed(), believed(**then))
    challenge.judge(window, believed(**now))
    assert challenge.refuted == refuted


def test_trusted_after_two_windows_won_and_no_more_after_two_lost(window: Window) -> None:
    challenge, right, wrong = ChampionChallengerTest(), believed(), believed(R=1.5)
    for model, filtered, trusted in (
        (right, wrong, False),
        (right, wrong, True),
        (wrong, right, True),
        (wrong, right, False),
    ):
        challenge.believe(model, filtered)
        challenge.judge(window, filtered)
        assert challenge.trusted == trusted


def test_nothing_is_refuted_by_a_window_of_another_device(window: Window) -> None:
    challenge = ChampionChallengerTest()
    challenge.believe(believed(), believed(R=1.5))
    challenge.forget()
    challenge.judge(window, believed(R=1.5))
    assert challenge.refuted == set()
