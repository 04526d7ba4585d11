"""A speed that its sensor filters, or takes from a difference over a window."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from servo_daemon.captures.capture.model import Capture
from servo_daemon.diagnosis.diagnose import diagnose
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.identification.output_error.discrepancy.lag_like import equivalents
from servo_daemon.samples import F64, SampleBlock, make_block
from tests.recovery.generator import GEAR_MOTOR, PAPER, Motor, Scenario, generate
from tests.recovery.generator.sensors import filtered_speed, speed_over_window

pytestmark = pytest.mark.usefixtures("generator_built")
T_F = 4e-3


def with_speed(motor: Motor, kind: str, seconds: float = 6.0) -> SampleBlock:
    """Voltage, current and speed; noise of 0.2 % of the speed."""
    made = generate(motor, Scenario("multisine", seconds, seed=1))
    truth = made.truth
    shown: F64
    if kind == "filter":
        shown = filtered_speed(truth.time_s, truth.speed_rad_s, T_F)
    else:
        shown = speed_over_window(truth.time_s, truth.position_rad, 2 * T_F)
    noise = np.random.default_rng(3).normal(0.0, 0.002 * float(np.std(shown)), len(shown))
    return make_block(made.time_s, voltage_V=made.voltage_V, current_A=made.current_A, velocity_rad_s=shown + noise)


@pytest.mark.parametrize("motor", [PAPER, GEAR_MOTOR], ids=lambda m: m.name)
def test_a_fit_with_the_filter_gives_motor_and_filter(motor: Motor) -> None:
    block = with_speed(motor, "filter", 3.0)
    fit = fit_output_error([Recording("capture", block)], ("speed_filter",))
    for name, true in ({n: getattr(motor, n) for n in "RLKJB"} | {"t_f": T_F}).items():
        p = fit.parameters[name]
        assert p.value is not None and p.std is not None
        assert abs(p.value - true) < 4 * p.std
        assert p.std < 0.02 * true
    blind = fit_output_error([Recording("capture", block)])
    assert not blind.white  # that this test can fail


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["filter", "window"])
def test_a_filter_of_the_speed_is_found(kind: str) -> None:
    b = with_speed(GEAR_MOTOR, kind)
    found = diagnose([Capture(Path("c.csv"), b.time_s, b.voltage_V, b.current_A, None, b.velocity_rad_s)])
    assert found.verdict == "found"
    names = {e.name for e in found.effects} | {name for e in found.effects for name in e.equivalent}
    assert "speed_filter" in names
    if kind == "filter":
        assert found.extended is not None
        t_f = found.extended.parameters["t_f"]
        assert t_f.value is not None and t_f.std is not None
        assert abs(t_f.value - T_F) < 4 * t_f.std


@pytest.mark.parametrize("motor", [PAPER, GEAR_MOTOR], ids=lambda m: m.name)
def test_without_a_current_a_filter_of_the_program_that_logs_leaves_l_and_its_lag_open(motor: Motor) -> None:
    """y += a (ω − y) once in 5 ms: no continuous filter is that, and L or t_f takes the difference."""
    made = generate(motor, Scenario("steps", 6.0, rate_hz=200.0, seed=4))
    share = 1.0 / 3.0  # the filter's lag is h (1/a − 1), two samples
    shown = lfilter([share], [1.0, share - 1.0], made.truth.speed_rad_s)
    noise = np.random.default_rng(3).normal(0.0, 0.001 * float(np.std(shown)), len(shown))
    block = make_block(made.time_s, voltage_V=made.voltage_V, velocity_rad_s=shown + noise)
    known = FitOptions(fixed={"R": motor.R, "K": motor.K})
    fit = fit_output_error([Recording("capture", block)], ("speed_filter",), known)
    for name, true in (("L", motor.L), ("J", motor.J), ("t_f", 0.01)):
        p = fit.parameters[name]
        assert p.value is None or p.std is None or abs(p.value - true) < max(4 * p.std, 0.05 * true)
    assert "speed_filter" in equivalents(fit.problem)["L"]
