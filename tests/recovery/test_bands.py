"""The 95 % bands of free runs hold 90 to 99 % of another day's samples, and the expected errors hold the errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.identification.procedure.bands import bands_of
from servo_daemon.samples import SampleBlock
from tests.recovery.captures import capture
from tests.recovery.generator import BELT_SERVO, GEAR_MOTOR, PAPER, Motor, Scenario

pytestmark = pytest.mark.usefixtures("generator_built")


def day(motor: Motor, motion: str, friction: float, seed: int) -> SampleBlock:
    effects = {"coulomb_friction": {"Tc": 0.1 * friction * motor.working_torque_Nm}}
    scenario = Scenario(motion, seconds=10, rate_hz=500, seed=seed, effects=effects)
    return capture(replace(motor, B=friction * motor.B), scenario).block


def fitted(block: SampleBlock) -> OutputErrorFit:
    return fit_output_error([Recording("a", block)], ("coulomb_friction",), FitOptions())


@pytest.mark.parametrize(
    ("motor", "motion"), [(PAPER, "pick_and_place"), (GEAR_MOTOR, "multisine"), (BELT_SERVO, "multisine")]
)
def test_bands_hold_what_they_say(motor: Motor, motion: str) -> None:
    first = day(motor, motion, 1.0, 1)
    fit = fitted(first)
    within = []
    for k, friction in enumerate((1.03, 0.97, 1.01)):
        found = bands_of(day(motor, motion, friction, 20 + k), fit, fit.coordinates(), [Recording("a", first)])
        assert found is not None
        for name, interval in found.intervals().items():
            assert 0.90 < interval.inside < 0.99, (friction, name, interval)
            rmse = float(np.sqrt(np.mean(found.error[:, found.channels.index(name)] ** 2)))
            assert interval.half_width < 4 * rmse, (friction, name)
            within.append(interval.expected[0] <= rmse <= interval.expected[1])
    assert np.mean(within) >= 0.85


def test_more_than_a_change_of_friction_is_not_expected() -> None:
    """Another motor: a third more inertia."""
    first = day(GEAR_MOTOR, "multisine", 1.0, 1)
    fit = fitted(first)
    other = day(replace(GEAR_MOTOR, J=1.33 * GEAR_MOTOR.J), "multisine", 1.0, 30)
    found = bands_of(other, fit, fit.coordinates(), [Recording("a", first)])
    assert found is not None
    rmse = np.sqrt(np.mean(found.error**2, axis=0))
    speed = found.channels.index("velocity_rad_s")
    assert rmse[speed] > 1.5 * found.expected[speed, 1]
