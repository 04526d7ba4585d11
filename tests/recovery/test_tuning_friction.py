"""What `advice` says of dry friction, against the independent generator's motor, which sticks exactly."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servo_daemon.samples import F64
from servo_daemon.tuning.advice import Advice, advise
from servo_daemon.tuning.knowledge import NEEDED, CascadeGains, Known, LoopSetup, MotorKnowledge
from servo_daemon.tuning.laws import StateGains
from tests.recovery.generator import PAPER, Scenario, Sensors, generate
from tests.recovery.generator.motions import Gains, Plan

TC = 0.3
SETUP = LoopSetup(1000.0, delay_samples=0.0, voltage_V=24.0, counts_per_rev=16384)
P_ONLY = CascadeGains(1.2, 0.0, 10.0)
WITH_INTEGRAL = CascadeGains(1.2, 84.0, 10.0)


def advice(gains: CascadeGains | StateGains, effects: tuple[str, ...] = ("coulomb_friction",)) -> Advice:
    known = {name: Known(getattr(PAPER, name), "estimate") for name in NEEDED}
    motor = MotorKnowledge(known, effects=effects, extras={"Tc": TC, "Tg": 2.0})
    return advise(gains, None, motor, SETUP)


def angle(gains: CascadeGains, step_rad: float, seconds: float) -> F64:
    """Of the generator's drive with dry friction, after a step of the reference. Its integral holds the errors before
    the present one: k_p takes the difference."""
    own = Gains(
        gains.speed_kp_V_s_rad + gains.speed_ki_V_rad * 1e-3,
        gains.speed_ki_V_rad,
        gains.position_kp_1_s or 0.0,
        1e-6,
        1e9,
    )
    plan = Plan("position", np.full(round(1000 * seconds), step_rad), gains=own)
    scenario = Scenario(plan, seconds, sensors=Sensors(), effects={"coulomb_friction": {"Tc": TC}})
    return generate(PAPER, scenario).truth.position_rad


def test_without_an_integral_it_may_stop_as_far_off_as_told() -> None:
    told = advice(P_ONLY)
    assert told.breakaway_V == pytest.approx(PAPER.R * TC / PAPER.K)
    error = told.breakaway_V / (1.2 * 10.0)
    assert any(f"up to {error:.3g} rad off" in note for note in told.notes)
    assert np.abs(angle(P_ONLY, 0.98 * error, 0.5)).max() == 0.0, "an error just below it does not move the shaft"
    assert np.abs(angle(P_ONLY, 1.02 * error, 0.5)).max() > 0.0


def test_with_an_integral_the_voltage_winds_up_as_told() -> None:
    """A small step is stuck until (P' + I t) ε is the breakaway voltage (and the current has followed)."""
    told = advice(WITH_INTEGRAL)
    P, integral = 1.2 * 10.0, 84.0 * 10.0
    assert told.breakaway_V is not None
    step = 0.01 * told.breakaway_V / P
    moved = np.flatnonzero(angle(WITH_INTEGRAL, step, 3.0))
    expected = (told.breakaway_V - P * step) / (integral * step)
    assert expected < moved[0] * 1e-3 < expected + 2 * PAPER.L / PAPER.R
    wait = 2 * told.breakaway_V / (integral * 2 * math.pi / 16384)
    assert any("hunts" in note and f"takes {wait:.3g} s" in note for note in told.notes)


def test_the_voltage_of_one_count_is_what_the_law_makes_of_it() -> None:
    count = 2 * math.pi / 16384
    assert advice(P_ONLY).ripple_V == pytest.approx(1.2 * count * 1000.0)
    quieter = advice(CascadeGains(1.2, 0.0, 10.0, filter_hz=50.0))
    assert quieter.ripple_V == pytest.approx(1.2 * count * 1000.0 * (1 - math.exp(-0.1 * math.pi)))
    state = advice(StateGains(100.0, 1.5, 0.1, 2000.0, (0.1,), 0.6, None))
    assert state.ripple_V == pytest.approx(1.5 * count * 1000.0)
    assert any("measured current" in note for note in state.notes)


def test_gravity_is_compared_with_the_loops_stiffness() -> None:
    """K P / R = 7.4 N·m/rad, against 2 N·m/rad of gravity."""
    notes = advice(P_ONLY, ("gravity_load",)).notes
    assert any("27 % of the loop's" in note for note in notes)
    assert not any("friction" in note for note in notes)


def test_a_speed_loop_pays_at_reversals() -> None:
    assert any("each reversal costs the loop a jump of 0.967 V" in x for x in advice(CascadeGains(1.2, 84.0)).notes)
    assert any("keeps a speed error" in x for x in advice(CascadeGains(1.2, 0.0)).notes)
