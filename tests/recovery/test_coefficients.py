"""Method 1 on data of the independent generator: the corrected form finds the motor where R is right."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.errors import BadInputError
from servo_daemon.identification.paper.coefficients import compare_coefficients
from servo_daemon.identification.paper.process_model import fit_process_model
from servo_daemon.samples import SampleBlock, make_block
from tests.recovery.generator import LARGE_SERVO, MOTORS, PAPER, Recording, Scenario, generate

pytestmark = pytest.mark.usefixtures("generator_built")


def block(r: Recording) -> SampleBlock:
    return make_block(r.time_s, voltage_V=r.voltage_V, current_A=r.current_A, position_rad=r.position_rad)


@pytest.mark.parametrize(
    ("motor", "motion"),
    [
        ("paper", "multisine"),
        *(pytest.param(m, "prbs", marks=pytest.mark.slow) for m in MOTORS),
        *(pytest.param(m, "multisine", marks=pytest.mark.slow) for m in MOTORS if m != "paper"),
    ],
)
def test_process_model(motor: str, motion: str) -> None:
    """Quantised encoder, jitter, hidden voltage noise, no steps: gain and sum of the time constants to 0.2 %, their
    product to 4 % where L/R is a third of the sampling period, and within the stated deviations."""
    m = MOTORS[motor]
    N = m.R * m.B + m.K**2
    truth = np.array([m.K / N, (m.R * m.J + m.B * m.L) / N, m.J * m.L / N])
    for seed in (1, 2):
        p = fit_process_model([block(generate(m, Scenario(motion, seed=seed)))])
        error = np.array([p.gain, p.sum_s, p.product_s2]) - truth
        assert (np.abs(error / truth) < [0.002, 0.002, 0.04]).all(), error / truth
        assert (np.abs(error) < 4.5 * p.std).all(), error / p.std
        fast, slow = p.time_constants_s
        assert fast * slow == pytest.approx(p.product_s2) and fast + slow == pytest.approx(p.sum_s)


@pytest.mark.parametrize("motor", MOTORS)
def test_corrected_method(motor: str) -> None:
    m = MOTORS[motor]
    found = compare_coefficients([block(generate(m, Scenario("prbs", seed=3)))], m.R)
    for name, rel in (("L", 0.04), ("K", 0.002), ("J", 0.006), ("B", 0.12)):
        e = found.parameters[name]
        assert e.value == pytest.approx(getattr(m, name), rel=rel), name
        assert abs(e.value - getattr(m, name)) < 4 * e.std, name
    assert found.gain_ratio == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_steady_sections_are_used_where_there_are_some() -> None:
    steady = compare_coefficients([block(generate(PAPER, Scenario("prbs", seed=1)))], PAPER.R)
    assert steady.steady.source == "steady" and steady.steady.sections > 20
    never = compare_coefficients([block(generate(PAPER, Scenario("multisine", seed=2)))], PAPER.R)
    assert never.steady.source == "slow"
    assert any("never steady" in note for note in never.notes)


def test_underdamped_motor_has_a_complex_pair() -> None:
    found = compare_coefficients([block(generate(LARGE_SERVO, Scenario("prbs", seed=1)))], LARGE_SERVO.R)
    assert found.process.time_constants_s[0].imag != 0.0
    assert any("complex pair" in note for note in found.notes)


@pytest.mark.slow
def test_a_wrong_R_shifts_everything_or_is_refused() -> None:
    """The paper's R for method 1 is three times that of method 2: on such a motor K and D become artefacts."""
    data = block(generate(PAPER, Scenario("prbs", seed=1)))
    with pytest.raises(BadInputError, match="assumed R"):
        compare_coefficients([data], 1.5)
    shifted = compare_coefficients([data], 0.55)
    assert shifted.parameters["K"].value == pytest.approx(PAPER.K - (0.55 - PAPER.R) * PAPER.B / PAPER.K, rel=0.01)
