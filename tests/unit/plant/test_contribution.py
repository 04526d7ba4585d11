"""What an effect adds, read off its terms."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.plant.contribution import contribution
from servo_daemon.plant.core import Drive
from servo_daemon.plant.effects import effects_by_name

DRIVES: tuple[Drive, ...] = ("voltage", "current", "torque")
T = np.arange(400) * 1e-3
MOTION = {
    "t": T,
    "i": 3 * np.cos(20 * T),
    "omega": 8 * np.sin(15 * T),
    "theta": np.cumsum(8 * np.sin(15 * T)) * 1e-3,
    "h": np.full(400, 1e-3),
    "sliding": np.sign(np.sin(15 * T)),
    "flowing": np.sign(np.cos(20 * T)),
}


@pytest.mark.parametrize(
    ("name", "linear"),
    [
        ("coulomb_friction", {"Tc"}),
        ("stribeck_friction", {"Tc", "Ts"}),
        ("gravity_load", {"Tg"}),
        ("current_sensor_gain", set()),  # linear, and yet not nothing where it is 0
        ("magnetic_saturation", set()),
        ("winding_heating", set()),  # by way of its state
    ],
)
def test_linear_parameters(name: str, linear: set[str]) -> None:
    assert {p.name for p in contribution(name).linear} == linear


def test_torques_and_voltages_along_a_motion() -> None:
    values = {"R": 0.5, "K": 0.3, "B": 0.1, "Tc": 0.2, "Tc_neg": 0.3, "B_neg": 0.15, "c2": 0.02, "I_sat": 4.0}
    omega, i = MOTION["omega"], MOTION["i"]
    drag = contribution("quadratic_drag").along(MOTION, values)
    np.testing.assert_allclose(drag["torque"][:, 0], 0.02 * omega * np.abs(omega), atol=1e-14)
    np.testing.assert_allclose(drag["torque"][:, 1], omega * np.abs(omega), atol=1e-12)
    assert not drag["voltage"].any()
    levels = contribution("asymmetric_friction").along(MOTION, values)["torque"][:, 0]
    back = np.where(omega < 0, -0.3 + 0.05 * omega, 0.2)
    moving = np.abs(omega) > 1e-9
    np.testing.assert_allclose(levels[moving], back[moving], atol=1e-12)
    lost = 1 - 1 / (1 + (i / 4.0) ** 2)
    saturation = contribution("magnetic_saturation").along(MOTION, values)
    np.testing.assert_allclose(saturation["torque"][:, 0], 0.3 * i * lost, atol=1e-12)
    np.testing.assert_allclose(saturation["voltage"][:, 0], -0.3 * omega * lost, atol=1e-12)


def test_a_state_is_carried_along() -> None:
    values = {"R": 0.5, "R_th": 2.0, "C_th": 0.1}
    constant = {"t": T, "i": np.full(400, 3.0), "h": np.full(400, 1e-3)}
    found = contribution("winding_heating").along(constant, values)["voltage"][:, 0]
    assert found[0] == 0.0
    # ϑ' = (R (1 + α ϑ) i² − ϑ/R_th)/C_th from 0
    alpha, heat = 0.0039, 0.5 * 9.0
    rate = (alpha * heat - 1 / 2.0) / 0.1
    rise = heat / 0.1 / rate * np.expm1(rate * T)
    np.testing.assert_allclose(found, 0.5 * 3.0 * alpha * rise, rtol=1e-9, atol=1e-12)


def test_what_a_drive_without_a_voltage_shows() -> None:
    winding = {"winding_heating", "resistance_step", "brush_voltage_drop", "freewheel_drive"}
    sensors = {"current_sensor_offset", "current_sensor_gain", "voltage_sensor_offset"}
    silent = {drive: {n for n in effects_by_name() if not contribution(n).shows(drive)} for drive in DRIVES}
    assert silent["voltage"] == set()
    assert silent["current"] == winding | sensors | {"drive_lag"}
    assert silent["torque"] == winding | sensors | {"torque_ripple", "magnetic_saturation"}


def test_offsets() -> None:
    found = {(n, b) for n in effects_by_name() for b in ("torque", "voltage") if contribution(n).is_offset(b)}
    assert found == {("constant_load_torque", "torque"), ("voltage_sensor_offset", "voltage")}
