"""A bridge that is open where the command is zero: seen, named, and no name on drives that brake there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture
from servo_daemon.diagnosis.diagnose import DiagnoseOptions, diagnose
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.model_discrepancy import longest_missing
from servo_daemon.diagnosis.trial.noise_floor import measured_levels, noise_floor
from servo_daemon.diagnosis.trial.split import CHOICE
from servo_daemon.diagnosis.trial.trial import fit_trial
from servo_daemon.diagnosis.verdict.result import Diagnosis
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.samples import make_block
from tests.recovery.field.draws import pulses
from tests.recovery.generator import (
    BELT_SERVO,
    GEAR_MOTOR,
    RE40,
    EffectValues,
    Motor,
    Plan,
    Scenario,
    generate,
    typical,
)
from tests.recovery.generator import Recording as Made

pytestmark = pytest.mark.usefixtures("generator_built")

_COLUMNS = ("voltage_V", "current_A", "position_rad")


def commanded(motor: Motor, seconds: float, rate_hz: float, seed: int) -> Plan:
    return pulses(motor, np.arange(round(seconds * rate_hz)) / rate_hz, np.random.default_rng(seed))


def made(motor: Motor, *, opens: bool, seed: int = 3, rate_hz: float = 500.0) -> Made:
    effects: dict[str, EffectValues] = {"freewheel_drive": {}} if opens else {}
    plan = commanded(motor, 12.0, rate_hz, seed)
    return generate(motor, Scenario(plan, seconds=12, rate_hz=rate_hz, seed=seed, effects=effects))


def diagnosed(of: Made, **signals: np.ndarray) -> Diagnosis:
    chosen = signals or {name: getattr(of, name) for name in _COLUMNS}
    return diagnose([Capture(Path("c.csv"), time_s=of.time_s, **chosen)], [], DiagnoseOptions())  # type: ignore[arg-type]


def test_the_generator_s_open_bridge_lets_the_motor_coast() -> None:
    """No current where the command is zero, and a speed that falls by friction alone."""
    coasting, braking = (made(GEAR_MOTOR, opens=opens).truth for opens in (True, False))
    command = commanded(GEAR_MOTOR, 12.0, 500.0, 3).reference
    late = np.flatnonzero((command[2:] == 0) & (command[1:-1] == 0) & (command[:-2] == 0)) + 2
    assert np.all(coasting.current_A[late] == 0.0)
    assert np.max(np.abs(braking.current_A[late])) > 0.1
    inside = late[:-1][np.diff(late) == 1]
    share = np.exp(-GEAR_MOTOR.B / GEAR_MOTOR.J * (coasting.time_s[inside + 1] - coasting.time_s[inside]))
    assert np.allclose(coasting.speed_rad_s[inside + 1], share * coasting.speed_rad_s[inside], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("motor", [GEAR_MOTOR, BELT_SERVO], ids=lambda m: m.name)
def test_the_motor_comes_out(motor: Motor) -> None:
    of = made(motor, opens=True, rate_hz=1000.0)
    recording = Recording("c", make_block(of.time_s, **{name: getattr(of, name) for name in _COLUMNS}))
    plain = fit_output_error([recording], (), FitOptions())
    fit = fit_output_error([recording], ("freewheel_drive",), FitOptions())
    assert fit.white and not plain.white
    for name in ("R", "L", "K", "J", "B"):
        p = fit.parameters[name]
        assert p.value == pytest.approx(getattr(motor, name), rel=0.01), name


def test_noise_closes_no_bridge() -> None:
    """A command of zero with noise on it is another one: of the motor's way without a brake nothing is left."""
    of, effects = made(GEAR_MOTOR, opens=True), ("freewheel_drive",)
    recording = Recording("c", make_block(of.time_s, **{name: getattr(of, name) for name in _COLUMNS}))
    data = Data.of([recording], {}, effects, 0.5)
    trial = fit_trial(data, effects, {n: getattr(GEAR_MOTOR, n) for n in ("R", "L", "K", "J", "B")})
    assert trial is not None
    levels = measured_levels(longest_missing(data, trial))
    assert noise_floor(levels, trial, CHOICE).nrmse == pytest.approx(trial.choice.nrmse, rel=0.5)


@pytest.mark.slow
def test_it_is_named() -> None:
    found = diagnosed(made(GEAR_MOTOR, opens=True))
    assert (found.verdict, [effect.name for effect in found.effects]) == ("found", ["freewheel_drive"])


@pytest.mark.slow
@pytest.mark.parametrize("motor", [GEAR_MOTOR, BELT_SERVO], ids=lambda m: m.name)
def test_a_drive_that_brakes_is_not(motor: Motor) -> None:
    assert diagnosed(made(motor, opens=False)).verdict == "none"


@pytest.mark.slow
@pytest.mark.parametrize(("motor", "motion"), [(GEAR_MOTOR, "multisine"), (RE40, "reversals")], ids=["gear", "re40"])
def test_drag_is_a_candidate_with_voltage_current_and_speed(motor: Motor, motion: str) -> None:
    of = generate(
        motor, Scenario(motion, seconds=12, rate_hz=500, seed=3, effects=typical("quadratic_drag", motor, 0.2))
    )
    noise = np.random.default_rng(1).normal(0.0, 2e-3 * motor.speed_max_rad_s, len(of.time_s))
    found = diagnosed(of, voltage_V=of.voltage_V, current_A=of.current_A, velocity_rad_s=of.truth.speed_rad_s + noise)
    assert (found.verdict, [effect.name for effect in found.effects]) == ("found", ["quadratic_drag"])
