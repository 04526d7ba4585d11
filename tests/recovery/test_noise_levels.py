"""Noise that the diagnosis finds in captures, against what the generator has put there."""

from __future__ import annotations

from dataclasses import replace

import pytest

from servo_daemon.diagnosis.missing.missing import missing_inputs
from servo_daemon.identification.output_error import FitOptions, fit_output_error
from tests.recovery.captures import capture
from tests.recovery.generator import GEAR_MOTOR, LARGE_SERVO, RE40, Motor, Scenario, Sensors

pytestmark = pytest.mark.usefixtures("generator_built")


@pytest.mark.parametrize("motor", [RE40, LARGE_SERVO, GEAR_MOTOR], ids=lambda m: str(m.name))
@pytest.mark.parametrize("current", [True, False], ids=["with current", "without current"])
def test_noise_of_the_voltage_is_not_taken_for_a_torque_that_walks(motor: Motor, current: bool) -> None:
    """What a slow winding lets through of the voltage's noise looks like a torque that walks; nothing walks here."""
    recording = capture(motor, Scenario("multisine", seconds=10.0, seed=40))
    if not current:
        recording = replace(recording, block=replace(recording.block, current_A=None))
    fit = fit_output_error([recording], (), FitOptions(thorough=False))
    levels = missing_inputs(fit, recording.block, noise_first=True).levels
    # The four seconds that the likelihood looks at tell it to some 10 %.
    assert levels.input_var**0.5 == pytest.approx(Sensors.laboratory(motor).hidden_V, rel=0.3)
