"""Captures that hide an effect: the diagnosis sees the CSV only and must say what is in it."""

from __future__ import annotations

import pytest

from tests.recovery.hidden import UNNAMED, Case, judge
from tests.recovery.matrix import wilson

pytestmark = pytest.mark.usefixtures("generator_built")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cause", "motor", "motion"),
    [
        ("gravity_load", "re40", "reversals"),
        pytest.param("brush_voltage_drop", "large", "multisine", marks=pytest.mark.slow),
    ],
)
def test_a_clear_effect_is_named_with_its_parameters(cause: str, motor: str, motion: str) -> None:
    judgement = judge(Case(cause, "clear", motor, motion, 5), seconds=8.0)
    assert judgement.found == (cause,)
    assert judgement.outside == ()
    assert judgement.removed is not None
    assert judgement.removed > 0.9


def test_nothing_is_named_where_nothing_is_hidden() -> None:
    judgement = judge(Case("clean", "clear", "gear", "pick_and_place", 5), seconds=8.0)
    assert judgement.verdict == "none"
    assert judgement.found == ()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_drift_of_free_runs_is_not_taken_for_the_heat_of_a_winding() -> None:
    """What the recorded voltage does not show adds up along a free run of a light motor; a fit that knows of such noise
    needs no effect with a memory of its own."""
    judgement = judge(Case("clean", "clear", "re40", "pick_and_place", 4221))
    assert judgement.verdict == "none", judgement


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("cause", "strength", "motor", "motion", "seed"),
    [
        ("winding_heating", "clear", "re40", "pick_and_place", 891469),  # both models are white, one is far likelier
        ("measurement_delay", "faint", "large", "reversals", 102971),
        ("drive_lag", "clear", "paper", "pick_and_place", 101345),  # a late sensor makes the data white as well
        ("magnetic_saturation", "clear", "re40", "reversals", 66938),  # the baseline's own search does not settle
        ("shaft_compliance", "clear", "re40", "reversals", 212864),  # free runs bend the spring to follow their drift
    ],
)
def test_what_noise_hides_from_free_runs_is_seen_by_predictions(
    cause: str, strength: str, motor: str, motion: str, seed: int
) -> None:
    judgement = judge(Case(cause, strength, motor, motion, seed))
    assert judgement.found == (cause,), judgement
    assert judgement.tied == ()
    assert judgement.outside == ()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_brake_by_eddy_currents_is_no_stribeck_friction() -> None:
    """Its torque rises and falls with speed: the same three values fit it, with less friction at rest than at speed."""
    judgement = judge(Case("eddy_brake", "clear", "paper", "multisine", 7), seconds=15.0)
    assert judgement.found == (), judgement
    assert judgement.verdict == "unexplained"


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("cause", "strength", "motor", "motion", "seed"),
    [
        ("cogging_torque", "clear", "re40", "multisine", 248881),  # a few free runs turn the wrong way
        # friction by direction, which contains both, fits as well
        ("constant_load_torque+coulomb_friction", "clear", "re40", "reversals", 291001),
        ("brush_voltage_drop", "clear", "re40", "reversals", 291003),  # noise of the voltage is left as a torque
        (
            "measurement_delay",
            "clear",
            "re40",
            "steps",
            291004,
        ),  # a late current passes for noise
        ("position_dependent_friction", "clear", "gear", "steps", 240861),  # without it B is driven to nothing
        ("constant_load_torque+coulomb_friction", "clear", "gear", "reversals", 429300),  # friction one way only
        ("brush_voltage_drop", "clear", "gear", "reversals", 169485),  # its current reverses within a sample
        ("load_dependent_friction", "faint", "large", "steps", 744605),  # most of the runs that decide stand still
        ("position_dependent_friction", "clear", "gear", "pick_and_place", 702492),  # Coulomb's alone explains little
        ("position_dependent_friction", "clear", "paper", "pick_and_place", 644246),  # … or nothing
        ("resistance_step", "faint", "large", "pick_and_place", 358832),  # no current at the instant a descent found
        ("load_torque_step", "faint", "re40", "multisine", 435304),  # its instant in the next piece but one
        ("drive_lag", "clear", "gear", "steps", 609000),  # alike with the winding's in its place
    ],
)
def test_what_a_fit_was_caught_by_is_overcome(cause: str, strength: str, motor: str, motion: str, seed: int) -> None:
    judgement = judge(Case(cause, strength, motor, motion, seed))
    assert set(judgement.found) == set(judgement.expected), judgement
    assert judgement.outside == ()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_that_hide_each_other_are_found_at_once() -> None:
    judgement = judge(Case("encoder_eccentricity+coulomb_friction", "clear", "large", "reversals", 601974))
    assert set(judgement.found) == set(judgement.expected), judgement
    assert judgement.removed is not None
    assert judgement.removed > 0.9


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("cause", "motor", "motion"),
    [  # (the paper's motor with an eddy brake: the test before this one)
        *((cause, "large", "reversals") for cause in UNNAMED),
        *((cause, "paper", "steps") for cause in UNNAMED if cause != "eddy_brake"),
    ],
)
def test_what_the_library_does_not_hold_gets_no_name(cause: str, motor: str, motion: str) -> None:
    judgement = judge(Case(cause, "clear", motor, motion, 7), seconds=15.0)
    assert judgement.found == (), judgement
    assert judgement.verdict == "unexplained"


def test_wilsons_interval() -> None:
    """Against the values that Newcombe (1998, Statistics in Medicine 17, table I) prints for 81 of 263 and 0 of 20."""
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
