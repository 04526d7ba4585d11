"""Causes that hide where no current is measured: a sensor late by less than a sample in the winding's time constant,
dry friction in R and K."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture, read_capture
from servo_daemon.diagnosis.diagnose import diagnose
from servo_daemon.diagnosis.verdict.result import Diagnosis
from servo_daemon.errors import BadInputError
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.samples import make_block
from tests.recovery.generator import GEAR_MOTOR, LARGE_SERVO, RE40, EffectValues, Motor, Plan, Scenario, generate
from tests.recovery.generator import Recording as Made
from tests.recovery.hidden import Case, judge

_RATE_HZ, _SECONDS, _HELD_S = 50.0, 60.0, 0.1
_LATE_S = 0.015
_DRY = {"coulomb_friction": {"Tc": 0.1 * GEAR_MOTOR.K * GEAR_MOTOR.rated_current_A}}
_LATE = {"measurement_delay": {"t_d": _LATE_S, "channel": "position_rad"}}


def recorded(effects: Mapping[str, EffectValues]) -> Made:
    """Steps of voltage at random, every 0.1 s."""
    n, held = round(_SECONDS * _RATE_HZ), round(_HELD_S * _RATE_HZ)
    shares = np.random.default_rng(1).choice([-0.4, -0.2, 0.2, 0.4], size=n // held)
    voltage = np.repeat(shares, held) * GEAR_MOTOR.supply_V
    return generate(GEAR_MOTOR, Scenario(Plan("voltage", voltage), _SECONDS, _RATE_HZ, effects=effects, seed=1))


def diagnosed(effects: Mapping[str, EffectValues], folder: Path) -> Diagnosis:
    return diagnose([written(recorded(effects), folder)])


def written(made: Made, folder: Path) -> Capture:
    """Voltage and angle of it, as a capture."""
    rows, path = np.column_stack([made.time_s, made.voltage_V, made.position_rad]), folder / "capture.csv"
    np.savetxt(path, rows, delimiter=",", header="time_s,voltage_V,position_rad", comments="", fmt="%.12g")
    return read_capture(path)


@pytest.mark.slow
def test_a_late_angle_is_named_beside_dry_friction(tmp_path: Path) -> None:
    found = diagnosed(_DRY | _LATE, tmp_path)
    assert [e.name for e in found.effects] == ["coulomb_friction", "measurement_delay"]
    late = found.final.parameters["t_d"]
    assert late.value is not None
    assert late.std is not None
    # A lag of the winding (here 0.6 ms, and unknown without a current) looks like it, and is in the interval.
    assert abs(late.value - _LATE_S) < 2 * late.std + GEAR_MOTOR.L / GEAR_MOTOR.R
    assert late.std < 0.2 * _LATE_S


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effects", "names"), [({}, []), (_DRY, ["coulomb_friction"])], ids=["nothing", "dry friction"]
)
def test_nothing_is_late_where_nothing_is(
    effects: Mapping[str, EffectValues], names: list[str], tmp_path: Path
) -> None:
    assert [e.name for e in diagnosed(effects, tmp_path).effects] == names


@pytest.mark.slow
@pytest.mark.parametrize("motor", [GEAR_MOTOR, RE40], ids=lambda m: m.name)
def test_dry_friction_in_a_position_servo_is_no_spring(motor: Motor, tmp_path: Path) -> None:
    """The linear motor biases R and K around it until what is left looks like a spring in the shaft."""
    dry = {"coulomb_friction": {"Tc": 0.1 * motor.K * motor.rated_current_A}}
    made = generate(motor, Scenario("pick_and_place", seconds=20.0, effects=dry, seed=902))
    found = diagnose([written(made, tmp_path)])
    assert [e.name for e in found.effects] == ["coulomb_friction"]


@pytest.mark.slow
def test_friction_that_grows_with_the_load_is_no_other_motor(tmp_path: Path) -> None:
    """With another R and J the linear motor pushes and brakes as it does, and screening sees nothing of it."""
    made = generate(
        LARGE_SERVO, Scenario("pick_and_place", seconds=20.0, effects={"load_dependent_friction": {"mu": 0.2}}, seed=21)
    )
    found = diagnose([written(made, tmp_path)])
    assert [e.name for e in found.effects] == ["load_dependent_friction"]
    mu = found.final.parameters["mu"]
    assert mu.value is not None and mu.std is not None
    assert abs(mu.value - 0.2) < 3 * mu.std < 0.02


@pytest.mark.slow
def test_what_screening_sees_nothing_of_is_fitted_where_free_runs_err_beyond_the_noise() -> None:
    """Screening begins at a motor five times too large, where an eccentric encoder explains less than nothing."""
    judgement = judge(Case("encoder_eccentricity", "clear", "gear", "pick_and_place", 4, current=False))
    assert judgement.found == ("encoder_eccentricity",)


def test_how_late_is_known_where_nothing_else_is() -> None:
    """With L held at nearly nothing a direction of the motor is not quite without a trace: what it moves by a
    hundred-thousandth is known all the same. The channel is the one that is measured."""
    made = recorded(_LATE)
    block = make_block(made.time_s, voltage_V=made.voltage_V, position_rad=made.position_rad)
    fit = fit_output_error(
        [Recording("capture", block)], ("measurement_delay",), FitOptions(fixed={"L": 1e-6}, nominal={"t_d": 0.01})
    )
    assert fit.parameters["R"].status == fit.parameters["J"].status == "undetermined"
    late = fit.parameters["t_d"]
    assert late.status == "estimated"
    assert late.value == pytest.approx(_LATE_S + GEAR_MOTOR.L / GEAR_MOTOR.R, rel=0.05)


def test_the_late_channel_is_one_that_is_measured() -> None:
    made = recorded(_LATE)
    speed = np.gradient(made.position_rad, made.time_s)
    recordings = [Recording("capture", make_block(made.time_s, voltage_V=made.voltage_V, velocity_rad_s=speed))]
    fit = fit_output_error(recordings, ("measurement_delay",), FitOptions(nominal={"t_d": 0.01}))
    assert fit.parameters["channel"].value == 2.0
    with pytest.raises(BadInputError, match="channel = position_rad is not measured here, but velocity_rad_s"):
        fit_output_error(recordings, ("measurement_delay",), FitOptions(fixed={"channel": 1.0}))
