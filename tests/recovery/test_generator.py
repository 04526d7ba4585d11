"""The generator's equations: against exact solutions, and against scipy on the same equations written once more."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.recovery.generator import (
    MOTORS,
    PAPER,
    Motor,
    Start,
    typical,
)
from tests.recovery.open_loop import broadband, run, states, worst
from tests.recovery.reference_motor import exact_linear, integrate

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("generator_built")]


@pytest.mark.parametrize("motor", MOTORS.values(), ids=MOTORS)
def test_linear_motor_is_exact(motor: Motor) -> None:
    voltage = broadband(motor, 400)
    start = Start(current_A=0.3, speed_rad_s=2.0, position_rad=-1.0)
    recording = run(motor, voltage, 0.4, start=start, effects={"constant_load_torque": {"TL": 0.01}})
    assert worst(states(recording), exact_linear(motor, voltage, 1e-3, np.array([0.3, 2.0, -1.0]), 0.01)) < 1e-7


SMOOTH = (
    "quadratic_drag",
    "gravity_load",
    "cogging_torque",
    "torque_ripple",
    "constant_load_torque",
    "periodic_disturbance",
    "magnetic_saturation",
    "winding_heating",
    "shaft_compliance",
    "drive_lag",
    "sector_mass",
    "hysteresis_spring",
    "root_drag",
    "eddy_brake",
    "inductance_saturation",
)


@pytest.mark.parametrize("name", SMOOTH)
def test_smooth_effects_agree_with_scipy(name: str) -> None:
    """Both directions, 60 ms of a rough voltage."""
    voltage, start = broadband(PAPER, 60), (1.0, 2.0, 0.5)
    effects = typical(name, PAPER, 0.2, seconds=0.1)
    recording = run(PAPER, voltage, 0.06, effects=effects, start=Start(*start))
    # a reversal bends |ω| in these, which costs both integrators an order for one step
    tolerance = 1e-8 if name in {"quadratic_drag", "hysteresis_spring", "root_drag"} else 1e-10
    assert worst(states(recording), integrate(PAPER, effects, voltage, 1e-3, start)) < tolerance


@pytest.mark.parametrize("motor", MOTORS.values(), ids=MOTORS)
def test_all_smooth_effects_together(motor: Motor) -> None:
    voltage, start = broadband(motor, 40), (0.2 * motor.rated_current_A, 0.1 * motor.speed_max_rad_s, 0.5)
    effects = {key: value for name in SMOOTH for key, value in typical(name, motor, 0.1, seconds=0.1).items()}
    effects["cogging_torque"] = {
        **effects["cogging_torque"],
        **{
            f"{key}_{k}": 0.4 * float(effects["cogging_torque"][key]) * k
            for k in (2, 3)
            for key in ("Tcog", "n_cog", "phi_cog")
        },
    }
    recording = run(motor, voltage, 0.04, effects=effects, start=Start(*start))
    assert worst(states(recording), integrate(motor, effects, voltage, 1e-3, start)) < 1e-6


DIRECTED = (
    ("coulomb_friction",),
    ("stribeck_friction",),
    ("asymmetric_friction",),
    ("load_dependent_friction", "coulomb_friction", "torque_ripple"),
    ("position_dependent_friction",),
    ("sticky_spot",),
    ("brush_voltage_drop", "coulomb_friction"),
)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("names", DIRECTED, ids="+".join)
def test_friction_in_one_direction_agrees_with_scipy(names: tuple[str, ...], sign: int) -> None:
    """Sliding and conducting one way throughout, the sign-dependent effects are smooth as well."""
    voltage = sign * (6.0 + np.abs(broadband(PAPER, 60)))
    start = (sign * 3.0, sign * 0.3, 0.5)
    effects = {key: value for name in names for key, value in typical(name, PAPER, 0.1).items()}
    recording = run(PAPER, voltage, 0.06, effects=effects, start=Start(*start))
    assert np.all(recording.truth.slip == sign)
    assert worst(states(recording), integrate(PAPER, effects, voltage, 1e-3, start, sign)) < 2e-8


def test_ageing_holds_each_value_until_the_next_sample() -> None:
    """Two halves of a run with other parameters are two runs, the second from where the first ended."""
    before, after = PAPER, replace(PAPER, R=0.7, L=3e-3, K=0.25, J=0.012, B=0.4)
    voltage, half = broadband(PAPER, 200), 100
    ageing = {
        name: np.repeat([getattr(before, name), getattr(after, name)], half) for name in ("R", "L", "K", "J", "B")
    }
    ageing["TL"] = np.repeat([0.0, 0.5], half)
    recording = run(PAPER, voltage, 0.2, ageing=ageing)
    first = exact_linear(before, voltage[: half + 1], 1e-3, np.zeros(3))
    second = exact_linear(after, voltage[half:], 1e-3, first[-1], load=0.5)
    assert worst(states(recording), np.vstack([first[:-1], second])) < 1e-7
    assert all(np.array_equal(recording.truth.parameters[name], values) for name, values in ageing.items())


def test_order_is_kept_through_stick_slip_brush_drop_and_backlash() -> None:
    """Events are found exactly: halving the step divides the error by 2⁴, as if nothing had happened in between."""
    effects = {
        "stribeck_friction": {"Tc": 0.5, "Ts": 0.8, "ws": 1.0},
        "brush_voltage_drop": {"Vb": 0.6},
        "backlash": {"gap": 0.02, "k_s": 400.0, "c_s": 0.5, "J_l": 0.006},
    }
    voltage = 8 * np.sin(2 * math.pi * 7 * np.arange(500) * 1e-3)
    fine, *coarse = (
        states(run(PAPER, voltage, 0.5, effects=effects, inner_step_s=step)) for step in (1e-5, 4e-4, 2e-4, 1e-4)
    )
    errors = [worst(rows, fine) for rows in coarse]
    assert errors[0] / errors[1] > 8
    assert errors[1] / errors[2] > 8
    assert errors[2] < 1e-6
