"""A channel without variation: the blocked-rotor measurement of R and L, and a current sensor that is not there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import DriveInfo
from servo_daemon.captures.capture.model import Capture
from servo_daemon.config import DriveConfig
from servo_daemon.diagnosis.diagnose import diagnose
from servo_daemon.identification.output_error import OutputErrorFit, Recording, fit_output_error
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import SampleBlock, make_block
from tests.recovery.field.draws import held_steps
from tests.recovery.generator import GEAR_MOTOR, PAPER, RE40, Motor, Scenario, Start, generate

pytestmark = pytest.mark.usefixtures("generator_built")
MOTION = ("K", "J", "B")


def blocked(motor: Motor, *names: str, seconds: float = 4.0, seed: int = 0) -> SampleBlock:
    """The shaft held: an encoder that shows one count, or a speed of zero."""
    clamped = replace(motor, J=1e6, B=1e6)
    begin = Start(position_rad=np.pi / motor.counts_per_rev)  # between two edges of the encoder
    made = generate(clamped, Scenario(held_steps, seconds=seconds, seed=seed, start=begin))
    assert np.ptp(made.position_rad) == 0.0
    signals = {
        "voltage_V": made.voltage_V,
        "current_A": made.current_A,
        "position_rad": made.position_rad,
        "velocity_rad_s": np.zeros(len(made.time_s)),
    }
    return make_block(made.time_s, **{name: signals[name] for name in names})


def flickering(block: SampleBlock, *channels: str) -> SampleBlock:
    """An encoder between two of its counts."""
    noise = np.round(np.random.default_rng(3).normal(0.0, 0.4, len(block))) * 1e-3
    return replace(block, **{name: getattr(block, name) + noise for name in channels})


def fit(*blocks: SampleBlock) -> OutputErrorFit:
    return fit_output_error([Recording(f"capture {k}", block) for k, block in enumerate(blocks)])


@pytest.mark.parametrize("motor", [RE40, GEAR_MOTOR], ids=lambda m: m.name)
@pytest.mark.parametrize("channel", ["position_rad", "velocity_rad_s"])
def test_a_held_shaft_tells_r_and_l_as_exactly_as_no_motion_at_all(motor: Motor, channel: str) -> None:
    without = fit(blocked(motor, "voltage_V", "current_A"))
    found = fit(blocked(motor, "voltage_V", "current_A", channel))
    for name in ("R", "L"):
        p, other = found.parameters[name], without.parameters[name]
        assert p.value is not None and p.std is not None and other.value is not None and other.std is not None
        assert p.std < 1.05 * other.std
        assert p.value == pytest.approx(other.value, abs=0.7 * other.std)
        assert abs(p.value - getattr(motor, name)) < 4 * p.std
    assert all(found.parameters[name].value is None for name in MOTION)
    assert {name for d in found.null_directions for name in d.components} == set(MOTION)
    assert all(d.exact for d in found.null_directions)
    assert found.white


@pytest.mark.parametrize("channel", ["position_rad", "velocity_rad_s"])
def test_an_encoder_with_noise_is_no_motion(channel: str) -> None:
    block = blocked(GEAR_MOTOR, "voltage_V", "current_A", channel)
    found = fit(flickering(block, channel))
    for name in ("R", "L"):
        p = found.parameters[name]
        assert p.value is not None and p.std is not None
        assert abs(p.value - getattr(GEAR_MOTOR, name)) < 4 * p.std < 0.2 * p.value
    assert all(found.parameters[name].value is None for name in MOTION)


def test_beside_a_capture_that_moves_it_is_still_one_of_the_winding() -> None:
    """K, J and B are the moving capture's; R and L are known better by both."""
    made = generate(GEAR_MOTOR, Scenario("multisine", seconds=3.0, seed=5))
    names = ("voltage_V", "current_A", "position_rad")
    moving = make_block(made.time_s, **{name: getattr(made, name) for name in names})
    alone, both = fit(moving), fit(blocked(GEAR_MOTOR, *names), moving)
    for name in ("R", "L", *MOTION):
        p, before = both.parameters[name], alone.parameters[name]
        assert p.value is not None and p.std is not None and before.std is not None
        assert abs(p.value - getattr(GEAR_MOTOR, name)) < 4 * p.std
        assert p.std < 1.2 * before.std
    assert both.parameters["R"].std < 0.8 * alone.parameters["R"].std  # type: ignore[operator]


def test_nothing_is_missing_from_a_held_motor() -> None:
    block = blocked(RE40, "voltage_V", "current_A", "position_rad")
    found = diagnose([Capture(Path("held.csv"), block.time_s, block.voltage_V, block.current_A, block.position_rad)])
    assert found.verdict == "none"
    assert not found.effects


def test_a_current_that_never_changes_is_no_sensor() -> None:
    made = generate(GEAR_MOTOR, Scenario("multisine", seconds=4.0, seed=1))
    motion = {"voltage_V": made.voltage_V, "position_rad": made.position_rad}
    dead = fit(make_block(made.time_s, **motion, current_A=np.full(len(made.time_s), 0.25)))
    without = fit(make_block(made.time_s, **motion))
    assert dead.problem.channels == ("position_rad",)
    assert [(c.expression, c.value, c.std) for c in dead.combinations] == [
        (c.expression, c.value, c.std) for c in without.combinations
    ]


@pytest.mark.parametrize("flickers", [False, True])
@pytest.mark.parametrize("channel", ["position_rad", "velocity_rad_s"])
def test_live_a_held_shaft_tells_r_and_l(channel: str, *, flickers: bool) -> None:
    block = blocked(PAPER, "voltage_V", "current_A", channel)
    block = flickering(block, channel) if flickers else block
    pipeline = Pipeline(DriveConfig(), DriveInfo("test"))
    last = pipeline.process(block)[-1]
    published = {p.name: p for p in last.parameters}
    for name in ("R", "L"):
        p = published[name]
        assert p.status == "tracking" and p.value is not None and p.std is not None
        assert abs(p.value - getattr(PAPER, name)) < 4 * p.std
        assert p.std < 0.2 * p.value
    for name in MOTION:
        assert published[name].value is None
        assert "held" in (published[name].reason or "")


def test_live_a_shaft_that_stands_is_not_waited_for_in_vain() -> None:
    """Without a voltage nothing tells R: it is the motion that is missing, not more of the same."""
    current_A = np.random.default_rng(4).normal(0.0, 0.01, 4000)
    still = make_block(
        np.arange(4000) / 1e3, voltage_V=np.zeros(4000), current_A=current_A, position_rad=np.zeros(4000)
    )
    last = Pipeline(DriveConfig(), DriveInfo("test")).process(flickering(still, "position_rad"))[-1]
    assert {p.reason for p in last.parameters} == {"the shaft has not moved yet"}


@pytest.mark.parametrize("flickers", [False, True])
def test_live_a_shaft_that_is_let_go_is_a_motor_like_any_other(*, flickers: bool) -> None:
    names = ("voltage_V", "current_A", "position_rad")
    held = blocked(GEAR_MOTOR, *names, seconds=3.0)
    held = flickering(held, "position_rad") if flickers else held
    made = generate(GEAR_MOTOR, Scenario("multisine", seconds=20.0, seed=2))
    time_s = np.concatenate([held.time_s, held.time_s[-1] + 1e-3 + made.time_s])
    signals = {n: np.concatenate([getattr(held, n), getattr(made, n)]) for n in names}
    pipeline = Pipeline(DriveConfig(), DriveInfo("test"))
    last = pipeline.process(make_block(time_s, **signals))[-1]
    for p in last.parameters:
        assert p.status == "tracking" and p.value is not None and p.std is not None
        assert abs(p.value - getattr(GEAR_MOTOR, p.name)) < 4 * p.std + 0.01 * p.value
