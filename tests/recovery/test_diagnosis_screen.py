"""Unmodelled torque, screening and dependence on captures of the independent generator, which knows no plant of
ours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from servo_daemon.diagnosis.missing.balance import balanced_missing_inputs
from servo_daemon.diagnosis.missing.missing import Missing, missing_inputs
from servo_daemon.diagnosis.screening.dependence import dependences
from servo_daemon.diagnosis.screening.screen import screen
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.model_discrepancy import seen_missing
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.diagnosis.trial.trial import first_trial, fit_trial
from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, fit_output_error
from servo_daemon.identification.output_error import Recording as Capture
from servo_daemon.identification.output_error.problem.setup import make_problem
from servo_daemon.samples import SampleBlock, make_block
from tests.recovery.captures import Known
from tests.recovery.generator import GEAR_MOTOR, LARGE_SERVO, PAPER, RE40, Motor, Recording, Scenario, generate, typical

pytestmark = [pytest.mark.usefixtures("generator_built"), pytest.mark.slow]


def _captured(motor: Motor, scenario: Scenario) -> tuple[Recording, SampleBlock]:
    r = generate(motor, scenario)
    return r, make_block(r.time_s, voltage_V=r.voltage_V, current_A=r.current_A, position_rad=r.position_rad)


def _fit(motor: Motor, block: SampleBlock, fixed: Mapping[str, float] | None = None) -> OutputErrorFit:
    nominal = {name: float(getattr(motor, name)) for name in ("R", "L", "K", "J", "B")}
    return fit_output_error([Capture("test", block)], (), FitOptions(nominal=nominal, fixed=fixed or {}))


def _diagnosed(motor: Motor, motion: str, name: str | None, share: float) -> tuple[OutputErrorFit, Missing]:
    effects = typical(name, motor, share, seconds=8.0) if name else {}
    _, block = _captured(motor, Scenario(motion, seconds=8.0, effects=effects, seed=11))
    fit = _fit(motor, block)
    return fit, balanced_missing_inputs(fit, block)


def test_the_hidden_load_torque_lies_within_its_band() -> None:
    """A load torque that walks at random, hidden from the capture: 95 % of it within 1.96 standard deviations."""
    n, rate = 8000, 1000.0
    walk = 0.02 * PAPER.working_torque_Nm * np.cumsum(np.random.default_rng(4).normal(size=n)) / np.sqrt(rate) * 3
    recording, block = _captured(PAPER, Scenario("multisine", seconds=8.0, ageing={"TL": walk}, seed=2))
    fixed = {name: float(getattr(PAPER, name)) for name in ("R", "L", "K", "J")}
    fit = _fit(PAPER, block, fixed)
    names = fit.problem.plant.parameter_names
    truth = np.array([*(np.log(getattr(PAPER, name)) for name in names), 0.0])
    m = missing_inputs(fit, block, coordinates=truth)
    error = m.series["torque"] - recording.truth.parameters["TL"]
    assert np.corrcoef(m.series["torque"], walk)[0, 1] > 0.98
    assert 0.90 < np.mean(np.abs(error) < 1.96 * m.std["torque"]) < 0.99
    # what the drive added unseen is white noise of the input, and is found as such
    assert np.sqrt(m.levels.input_var) == pytest.approx(0.001 * PAPER.supply_V, rel=0.25)


@pytest.mark.parametrize("load", [-0.3, 0.3])
def test_beside_a_bent_fit_the_regression_says_what_the_load_is(load: float) -> None:
    """A load may pull either way: it has no logarithm."""
    pulled = load * PAPER.working_torque_Nm
    scenario = Scenario("multisine", seconds=8.0, effects={"constant_load_torque": {"TL": pulled}}, seed=11)
    _, block = _captured(PAPER, scenario)
    problem = make_problem([Capture("test", block)], ("constant_load_torque",), {})
    bent = {"R": 3 * PAPER.R, "L": PAPER.L, "K": PAPER.K / 3, "J": 10 * PAPER.J, "B": PAPER.B, "TL": 0.0}
    m = balanced_missing_inputs(Known(problem, bent), block)
    found = dict(zip(m.augmented.plant.parameter_names, m.coordinates, strict=True))
    assert found["TL"] == pytest.approx(pulled, rel=0.1)
    assert np.exp(found["K"]) == pytest.approx(PAPER.K, rel=0.05)


@pytest.mark.parametrize(
    ("motor", "motion", "name", "share", "parameter"),
    [
        (RE40, "reversals", "coulomb_friction", 0.04, "Tc"),
        (PAPER, "multisine", "cogging_torque", 0.04, "Tcog"),
        (LARGE_SERVO, "pick_and_place", "gravity_load", 0.04, "Tg"),
        (PAPER, "reversals", "brush_voltage_drop", 0.04, "Vb"),
        (GEAR_MOTOR, "pick_and_place", "encoder_eccentricity", 0.2, "e_enc"),
    ],
)
def test_screening_puts_the_cause_first(motor: Motor, motion: str, name: str, share: float, parameter: str) -> None:
    fit, missing = _diagnosed(motor, motion, name, share)
    best = screen(fit, missing)[0]
    truth = typical(name, motor, share, seconds=8.0)[name]
    assert best.effect == name
    assert best.heldout_share > 0.5
    assert best.start[parameter] == pytest.approx(truth[parameter], rel=0.1)
    if "n_cog" in truth:
        assert best.start["n_cog"] == truth["n_cog"]


def test_a_fast_ripple_is_not_taken_for_noise_of_the_voltage() -> None:
    """By likelihood white noise of the voltage explains it best; screening must see it all the same."""
    effects = {"torque_ripple": {"k_rip": 0.04, "n_rip": 9.0, "phi_rip": 2.24}}
    _, block = _captured(RE40, Scenario("reversals", seconds=20.0, effects=effects, seed=589189))
    recordings = (Capture("test", block),)
    data = Data.of(recordings, {}, (), segment_length_s(recordings))
    base = first_trial(data, (), {})
    best = screen(base, seen_missing(data, base))[0]
    assert best.effect == "torque_ripple"
    assert best.start["n_rip"] == 9.0
    assert best.heldout_share > 0.1


def test_runs_beside_a_point_where_the_rotor_cannot_stand_find_their_beginning() -> None:
    """Of 96 short runs of a cogging motor three turn the wrong way from the measured state: RMS 4 times too large."""
    effects = {"cogging_torque": {"Tcog": 0.03618, "n_cog": 20.0, "phi_cog": 1.9458251085769183}}
    _, block = _captured(RE40, Scenario("multisine", seconds=20.0, effects=effects, seed=248881))
    recordings = (Capture("test", block),)
    data = Data.of(recordings, {}, (), segment_length_s(recordings) / 8.0)
    truth = {name: float(getattr(RE40, name)) for name in ("R", "L", "K", "J", "B")} | effects["cogging_torque"]
    trial = fit_trial(data, ("cogging_torque",), truth, max_iterations=0)
    assert trial is not None
    assert trial.choice.nrmse < 0.7 * first_trial(data, (), {}).choice.nrmse


def test_parameters_bent_by_stiction_are_moved_before_looking() -> None:
    """Output error without friction makes the paper's motor another motor here: more than half the voltage missing."""
    fit, missing = _diagnosed(PAPER, "steps", "coulomb_friction", 0.2)
    best = screen(fit, missing)[0]
    assert best.effect == "coulomb_friction"
    assert best.start["Tc"] == pytest.approx(0.2 * PAPER.working_torque_Nm, rel=0.05)


def test_a_cause_without_a_name_is_followed() -> None:
    fit, missing = _diagnosed(LARGE_SERVO, "multisine", "eddy_brake", 0.2)
    first = dependences(fit, missing)[0]
    assert (first.series, first.on) == ("torque", "speed")
    assert first.share > 0.5


@pytest.mark.parametrize(("motor", "motion"), [(PAPER, "multisine"), (RE40, "reversals"), (GEAR_MOTOR, "steps")])
def test_nothing_is_followed_on_a_clean_capture(motor: Motor, motion: str) -> None:
    assert dependences(*_diagnosed(motor, motion, None, 0.0)) == ()
