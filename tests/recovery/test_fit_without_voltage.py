"""J from current and angle alone, where nobody says what the current did between its samples."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, Recording, fit_output_error
from servo_daemon.samples import make_block
from tests.recovery.generator import GEAR_MOTOR, LARGE_SERVO, PAPER, RE40, Motor, Scenario, generate, typical

MOTIONS = ("multisine", "steps", "pick_and_place")


def fitted(motor: Motor, motion: str, seed: int, *, winding: bool) -> OutputErrorFit:
    """5 s of a drive that holds its voltage from sample to sample.

    Args:
        winding: whether R and L are given beside K.
    """
    r = generate(motor, Scenario(motion, seconds=5.0, seed=seed))
    block = make_block(r.time_s, current_A=r.current_A, position_rad=r.position_rad)
    nominal = {"R": motor.R, "L": motor.L} if winding else {}
    return fit_output_error([Recording("capture", block)], (), FitOptions(nominal=nominal, fixed={"K": motor.K}))


def deviations(fit: OutputErrorFit, motor: Motor) -> tuple[float, float]:
    """Of J from the truth, and the reported standard deviation, both relative."""
    J = fit.parameters["J"]
    assert J.value is not None
    assert J.std is not None
    return J.value / motor.J - 1.0, J.std / J.value


def test_a_held_voltage_hides_inertia_and_the_deviation_holds_it() -> None:
    """2 % of an RE 40, in no residual; without R a usual motor's stands in, half a sample over 12 ms."""
    error, std = deviations(fitted(RE40, "multisine", 1, winding=True), RE40)
    assert error == pytest.approx(-0.0196, abs=0.001)
    assert std == pytest.approx(0.0196, abs=0.002)
    _, unaware = deviations(fitted(RE40, "multisine", 1, winding=False), RE40)
    assert unaware == pytest.approx(0.5 / 12, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("motion", MOTIONS)
def test_intervals_of_j_hold_the_truth(motion: str) -> None:
    found = [
        deviations(fitted(motor, motion, seed, winding=True), motor)
        for motor in (PAPER, RE40, GEAR_MOTOR)
        for seed in range(4)
    ]
    inside = [abs(error) < 1.96 * std for error, std in found]
    assert np.mean(inside) > 0.9


@pytest.mark.slow
def test_a_large_motor_is_within_a_part_in_a_thousand() -> None:
    """Its mechanical time constant is long against a sample."""
    for seed in range(4):
        error, _ = deviations(fitted(LARGE_SERVO, "multisine", seed, winding=True), LARGE_SERVO)
        assert abs(error) < 2e-3


@pytest.mark.parametrize("effect", ["coulomb_friction", "quadratic_drag"])
def test_losses_of_another_law_are_in_the_deviation_of_b(effect: str) -> None:
    """B takes them, and next to nothing is left that says so."""
    hidden = typical(effect, LARGE_SERVO, 0.15)
    r = generate(LARGE_SERVO, Scenario("prbs", seconds=5.0, rate_hz=500.0, effects=hidden, seed=2))
    recording = Recording("capture", make_block(r.time_s, current_A=r.current_A, position_rad=r.position_rad))
    honest, blind = (fit_output_error([recording], (), FitOptions(misfit=m)) for m in (True, False))
    true = {"J/K": LARGE_SERVO.J / LARGE_SERVO.K, "B/K": LARGE_SERVO.B / LARGE_SERVO.K}
    assert off(blind, true) > 20.0  # that this test can fail
    assert off(honest, true) < 4.0


def off(fit: OutputErrorFit, true: Mapping[str, float]) -> float:
    """The largest error of these combinations, in standard deviations, of those that are claimed."""
    found = {c.expression: c for c in fit.combinations}
    return max(abs(found[n].value - value) / found[n].std for n, value in true.items() if n in found)
