"""Noise that the diagnosis finds in captures, against what the generator has put there."""

from __future__ import annotations

from dataclasses import replace

import pytest

from servo_daemon.diagnosis.missing.missing import missing_inputs
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.full_data_fit import FullDataFits, fit_full_data
from servo_daemon.diagnosis.trial.model_discrepancy import longest_missing
from servo_daemon.diagnosis.trial.noise_floor import errs_beyond_noise
from servo_daemon.diagnosis.trial.trial import first_trial
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


@pytest.mark.parametrize("effect", [None, "encoder_eccentricity"])
def test_half_a_percent_of_the_signal_may_be_far_beyond_the_noise(effect: str | None) -> None:
    """An eccentric encoder leaves some tenths of a percent of the angle, which is forty times what noise leaves."""
    effects = {} if effect is None else {effect: {"e_enc": 0.02, "phi_enc": 2.8}}
    recording = capture(GEAR_MOTOR, Scenario("pick_and_place", seconds=10.0, effects=effects, seed=41))
    data = Data.of([replace(recording, block=replace(recording.block, current_A=None))], {}, (), 0.5)
    trial = first_trial(data, (), {})
    fit = fit_full_data(data.full, trial, FullDataFits(data.full))
    missing = longest_missing(data.full, fit)
    assert trial.choice.nrmse < 0.01
    assert errs_beyond_noise(data.full, fit, trial, missing) == (effect is not None)
