"""Commissioning from nothing, on motors with equations of their own, healthy and faulty."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servo_daemon.commissioning import MotionLimits, commission
from servo_daemon.commissioning.ends import stops
from servo_daemon.commissioning.envelope import Envelope
from servo_daemon.samples import SampleBlock
from tests.commanded_motor import HEALTHY, CommandedMotor, Setup, drawn

SMALL = HEALTHY["small"]


@pytest.mark.parametrize(("setup", "limits"), HEALTHY.values(), ids=HEALTHY.keys())
def test_three_motors_are_known_from_nothing(setup: Setup, limits: MotionLimits) -> None:
    motor = CommandedMotor(setup)
    result = commission(motor, limits)
    assert result.outcome == "known" and result.fit is not None
    assert result.motion_s < 60.0
    for name in ("R", "L", "K", "J", "B"):
        p, true = result.fit.parameters[name], getattr(setup, name)
        assert p.value is not None and p.std is not None
        assert abs(p.value / true - 1.0) < 0.01, name
        assert p.std < 0.01 * true
        assert abs(p.value - true) < 4 * p.std
    assert motor.share_of(limits) <= 0.8
    assert abs(motor.state[1]) < 0.05 * limits.speed_rad_s  # at rest at the end


#: Seeds of `drawn`, one a fault, and what the run may call it.
FAULTY = (
    (0, {"encoder_sign"}),
    (1, {"current_sign"}),
    (2, {"no_motion"}),
    (5, {"hard_stop", "motion_ended"}),
    (7, {"encoder_lost"}),
    (700_135, {"encoder_lost"}),  # it dies after six counts: 1.3 times the greatest speed unseen, once
    (30, {"data_missing"}),
)


@pytest.mark.parametrize(("seed", "names"), FAULTY)
def test_a_faulty_set_up_is_stopped_within_its_limits(seed: int, names: set[str]) -> None:
    setup, limits, _ = drawn(seed)
    motor = CommandedMotor(setup)
    result = commission(motor, limits)
    assert result.stop is not None and result.stop.reason in names
    assert motor.share_of(limits) <= 1.01
    assert abs(motor.state[1]) < 0.2 * limits.speed_rad_s  # it runs down: nothing drives it any more


def test_a_coarse_encoder_that_stands_is_no_dead_one() -> None:
    """Within a count the shaft turns to and fro unseen, and its back-EMF shows it."""
    setup, limits = SMALL
    assert commission(CommandedMotor(replace(setup, counts_per_rev=200.0)), limits).stop is None


@pytest.mark.slow
def test_a_shaft_that_sticks_most_of_the_time_is_known_well_enough_for_a_round() -> None:
    """Of 4 s of a first look it moves in the last."""
    setup, limits, fault = drawn(43)
    steps: list[str] = []
    result = commission(
        CommandedMotor(setup),
        limits,
        interrupted=lambda: any(step.startswith("round") for step in steps),
        progress=lambda _seconds, step: steps.append(step),
    )
    assert fault == "friction"
    assert result.stop is not None and result.stop.reason == "interrupted"


@pytest.mark.parametrize(
    ("wrong", "reason", "said"),
    [
        ({"encoder_dies_s": 1.2}, "encoder_lost", "the motor turns"),
        ({"encoder_dies_s": 1.2, "Tc": 0.003}, "encoder_lost", "the motor turns"),
        ({"encoder_dies_s": 0.0}, "encoder_lost", "the motor turns"),
        ({"locks_s": 1.2}, "hard_stop", "no back-EMF"),
        ({"locked": True}, "no_motion", "winding at rest"),
    ],
    ids=["encoder dies", "and there is friction", "encoder never counts", "shaft gets stuck", "shaft is locked"],
)
def test_an_encoder_that_stands_before_the_motor_is_known(wrong: dict[str, Any], reason: str, said: str) -> None:
    setup, limits = SMALL
    motor = CommandedMotor(replace(setup, **wrong))
    result = commission(motor, limits)
    assert result.stop is not None and result.fit is None
    assert result.stop.reason == reason and said in result.stop.text
    assert motor.share_of(limits) <= 1.01


@pytest.mark.parametrize("seed", [13, 45])
def test_stops_too_near_for_a_first_look_are_named_with_their_places(seed: int) -> None:
    setup, limits, fault = drawn(seed)
    motor = CommandedMotor(setup)
    result = commission(motor, limits)
    assert fault == "hard_stop"
    assert result.stop is not None and result.stop.reason == "hard_stop"
    places = [float(x) for x in re.findall(r"at (-?[\d.]+)", result.stop.text)]
    assert places
    for place in places:
        assert abs(place) == pytest.approx(setup.stop_rad, abs=0.01)
    assert motor.share_of(limits) <= 1.01


def test_a_shaft_that_sticks_or_turns_round_by_itself_is_at_no_stop() -> None:
    time_s = 1e-3 * np.arange(3000)
    swing = np.exp(time_s) * np.sin(2 * np.pi * 2.0 * time_s)
    assert stops(time_s, swing, -swing, 0.1, 1e-3) == []
    assert stops(time_s, np.clip(swing, -1.0, 2.0), swing, 0.1, 1e-3) == pytest.approx([-1.0, 2.0])
    assert stops(time_s, np.clip(swing, -1.0, 2.0), swing, 10.0, 1e-3) == []  # less than what moved it first


def test_time_that_is_used_up_is_no_fault_of_the_shaft() -> None:
    setup, limits = SMALL
    result = commission(CommandedMotor(replace(setup, Tc=0.01)), replace(limits, seconds=0.5))
    assert (result.outcome, result.stop) == ("not_known", None)
    assert len(result.unknown) == 5


def test_silence_and_the_user_stop_the_motor() -> None:
    setup, limits = SMALL
    silent = CommandedMotor(setup, silent_after_s=3.0)
    result = commission(silent, limits)
    assert result.stop is not None and result.stop.reason == "data_missing"
    asked = 0

    def interrupted() -> bool:
        nonlocal asked
        asked += 1
        return asked > 3000

    motor = CommandedMotor(setup)
    result = commission(motor, limits, interrupted=interrupted)
    assert result.stop is not None and result.stop.reason == "interrupted"
    assert motor.commanded_V == 0.0
    assert abs(motor.state[1]) < 0.01 * limits.speed_rad_s


class Breaking(CommandedMotor):
    """Its reading is interrupted in the middle of a motion."""

    def read(self, timeout_s: float) -> SampleBlock | None:
        if self.commanded_V > 0.1:
            raise KeyboardInterrupt
        return super().read(timeout_s)


def test_whatever_ends_the_loop_the_last_command_is_0_V() -> None:
    motor = Breaking(SMALL[0])
    with pytest.raises(KeyboardInterrupt):
        commission(motor, SMALL[1])
    assert motor.commanded_V == 0.0


def test_a_motor_too_strong_for_its_limits_is_stopped_before_them() -> None:
    """A load that pulls: what nothing has commanded is not allowed either."""
    setup, limits = SMALL
    motor = CommandedMotor(setup)
    motor.push(speed_rad_s=2.0)
    result = commission(motor, limits)
    assert result.stop is not None and result.stop.reason == "not_at_rest"


def test_a_limit_is_reached_before_it_is_passed() -> None:
    setup, limits = SMALL
    for tight in (replace(limits, travel_rad=0.15), replace(limits, speed_rad_s=2.0)):
        motor = CommandedMotor(setup)
        commission(motor, replace(tight, seconds=6.0))
        assert motor.share_of(tight) <= 1.01


def test_the_envelope_holds_for_a_shaft_that_stops_or_comes_back() -> None:
    e = Envelope(R=2.0, K=0.1, voltage_V=24.0, current_A=3.0)
    for speed in (-30.0, -5.0, 0.0, 12.0, 40.0):
        for wanted in (-24.0, 0.0, 24.0):
            v = e.clamp(wanted, speed)
            currents = [(v - 0.1 * w) / 2.0 for w in (speed, 0.0, -0.5 * speed)]
            assert max(map(abs, currents)) <= 3.0
    assert e.clamp(1.0, 0.0) == 1.0
    assert math.isclose(e.clamp(24.0, 0.0), 0.85 * 2.0 * 3.0)
