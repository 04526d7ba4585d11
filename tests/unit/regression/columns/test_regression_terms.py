"""Columns that effects add to the regressions: coefficients, their slopes, and the way back to the parameters."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.kalman.gaussian import from_coordinate, to_coordinate
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.effects import parameter_table
from servo_daemon.regression.columns.terms import (
    armature_columns,
    armature_offsets,
    as_parameters,
    coefficient,
    columns_of,
    given_by,
    is_share,
    shaft_columns,
    shaft_signals,
)
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.stretch import Stretch

TABLE = parameter_table()
#: Of everything that some column needs, none of it at a special place.
_LINEAR = {"R": 0.5, "L": 2e-3, "K": 0.3, "J": 0.01, "B": 0.5, "TL": -0.1, "c2": 0.02}
_FRICTION = {
    "Tc": 0.2,
    "Tc_neg": 0.3,
    "B_neg": 0.4,
    "Ts": 0.35,
    "ws": 2.0,
    "mu": 0.1,
    "Tc_slope": 0.2,
    "Tc_curve": -0.03,
}
_WAVES = {
    "Tg": 0.4,
    "phi_g": 0.7,
    "Tper": 0.2,
    "f_per": 3.0,
    "phi_per": -0.5,
    "k_rip": 0.05,
    "n_rip": 9.0,
    "phi_rip": 2.0,
}
_COGGING = {"Tcog": 0.1, "n_cog": 12.0, "phi_cog": 0.3, "Tcog_2": 0.05, "n_cog_2": 24.0, "phi_cog_2": 1.1}
VALUE = _LINEAR | _FRICTION | _WAVES | _COGGING
EFFECTS = (
    "coulomb_friction",
    "load_dependent_friction",
    "position_dependent_friction",
    "quadratic_drag",
    "constant_load_torque",
    "gravity_load",
    "periodic_disturbance",
    "torque_ripple",
    "cogging_torque",
    "cogging_torque_2",
)
COLUMNS = (*shaft_columns(EFFECTS), *shaft_columns(("stribeck_friction",))[1:])


@pytest.mark.parametrize("column", ["J", "B", *COLUMNS])
def test_slopes_are_the_derivatives(column: str) -> None:
    _, slopes = coefficient(column, VALUE)
    for name, value in VALUE.items():
        p, step = TABLE[name], 1e-6
        at = to_coordinate(p, value)
        ahead, behind = (
            coefficient(column, {**VALUE, name: from_coordinate(p, at + sign * step, 0.0)[0]})[0] for sign in (1, -1)
        )
        assert (ahead - behind) / (2 * step) == pytest.approx(slopes.get(name, 0.0), abs=1e-8), name


def test_parameters_of_coefficients_and_their_errors() -> None:
    """There and back; the covariance as that of 20,000 draws."""
    columns = ("R", *COLUMNS)
    value = np.array([0.5, *(coefficient(c, VALUE)[0] for c in COLUMNS)])
    std = 0.01 * np.abs(value) + 1e-4
    rng = np.random.default_rng(1)
    found, covariance = as_parameters(columns, value, np.diag(std**2))
    for column, got in zip(columns, found.tolist(), strict=True):
        name = given_by(column)
        if name != "Tc" or column == "Tc":
            assert got == pytest.approx(VALUE[name], rel=1e-12), column
    draws = np.array(
        [
            as_parameters(columns, value + std * rng.standard_normal(len(value)), np.eye(len(value)))[0]
            for _ in range(20_000)
        ]
    )
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), draws.std(axis=0), rtol=0.05)
    correlation = np.corrcoef(draws.T)
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(covariance / np.outer(scale, scale), correlation, atol=0.05)


def stretch(speed: float, angle: float, current: float, t: float) -> Stretch:
    """Eleven samples about one instant, so short that all of them are that one."""
    offset = np.arange(-5, 6) * 1e-7
    n = np.ones(11)
    return Stretch(t + offset, n > 0, None, current * n, None, angle + speed * offset, None)


@pytest.mark.parametrize("effect", [*EFFECTS, "stribeck_friction"])
def test_columns_are_the_effects_torque(effect: str) -> None:
    """Against the plant itself: what the effect takes from dω/dt, at 40 random states."""
    base = {"position_dependent_friction": ("coulomb_friction",), "cogging_torque_2": ("cogging_torque",)}
    effects = (*base.get(effect, ()), effect)
    model, bare = build_plant(effects), build_plant(effects[:-1])
    rng = np.random.default_rng(2)
    for _ in range(40):
        speed, angle, current = rng.choice([-1, 1]) * rng.uniform(1, 5), rng.uniform(-3, 3), rng.uniform(-4, 4)
        t = rng.uniform(0, 10)
        h, x = 1e-6, np.array([current, speed, angle])
        voltage = 0.5 * current + 0.3 * speed  # so that the current stays as it is
        with_it, without = (
            float(m.step(x, voltage, [VALUE[p.name] for p in m.parameters], t, h)[1]) for m in (model, bare)
        )
        lost = VALUE["J"] * (without - with_it) / h
        s = stretch(speed, angle, current, t)
        names = columns_of(effect, effects)
        factors = [VALUE["K"] if is_share(c) else 1.0 for c in names]
        signals = shaft_signals(effect, s, VALUE)
        assert len(signals) == len(names)
        made = sum(f * coefficient(c, VALUE)[0] * x[5] for f, c, x in zip(factors, names, signals, strict=True))
        assert made == pytest.approx(lost, rel=2e-3, abs=2e-5), (speed, angle, current)


def test_friction_along_the_travel_needs_a_level_to_vary() -> None:
    assert columns_of("position_dependent_friction", ("position_dependent_friction", "stribeck_friction")) == ()
    assert shaft_columns(("cogging_torque", "coulomb_friction")) == ("cog_sin", "cog_cos", "Tc")


def test_columns_of_the_armature() -> None:
    assert armature_columns(("torque_ripple", "brush_voltage_drop", "current_sensor_offset")) == (
        "one",
        "Vb",
        "rip_sin",
        "rip_cos",
    )
    assert armature_columns(("gravity_load",)) == ()


def test_what_is_a_constant_of_the_armature_gives_an_offset() -> None:
    effects = ("brush_voltage_drop", "current_sensor_offset", "coulomb_friction", "voltage_sensor_offset")
    assert armature_offsets(effects) == ("i0", "v0")
    assert armature_offsets(effects[:1]) == ()


def test_without_a_current_no_share_of_it_is_a_column() -> None:
    """A column of zeros would keep the whole regression from an estimate."""
    plant = build_plant(("load_dependent_friction", "torque_ripple", "quadratic_drag"))
    assert MotorRls(plant, {"R": 0.5, "L": 2e-3, "K": 0.3}).names == ("J", "B", "c2")
    assert {"mu", "k_rip", "phi_rip"} < {*MotorRls(plant, {}).names}


def test_without_an_angle_no_wave_of_it_is_a_column() -> None:
    plant = build_plant(("cogging_torque", "torque_ripple", "gravity_load", "periodic_disturbance"))
    blind = MotorRls(plant, {}, sees_angle=False)
    assert blind.names == ("R", "L", "K", "J", "B", "Tper", "phi_per")
    assert {"Tcog", "k_rip", "Tg"} < {*MotorRls(plant, {}).names}
