"""How large the signals are: the larger remembered, and a unit for every parameter that is never zero."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servo_daemon.estimators.levels import Levels
from servo_daemon.estimators.stretch import Stretch
from servo_daemon.plant.build import Drive, build_plant
from servo_daemon.samples import F64

OFFSETS = ("constant_load_torque", "current_sensor_offset")
N = 100
#: Ticks of nothing: 2 s.
REST = 20


def tick(voltage: F64 | None = None, current: F64 | None = None, torque: F64 | None = None) -> Stretch:
    return Stretch(np.arange(N) * 1e-3, np.ones(N, dtype=bool), voltage, current, torque, np.zeros(N), None)


def levels(drive: Drive = "voltage", effects: tuple[str, ...] = ()) -> Levels:
    return Levels(build_plant(effects, drive))


def test_the_larger_is_remembered() -> None:
    """Up at once; down by 1 % of the square a tick, so that a rest of 2 s is no smaller motor."""
    found = levels()
    found.take(tick(np.full(N, 3.0), np.full(N, 1.0)))
    found.take(tick(np.full(N, 12.0), np.full(N, -4.0)))
    assert found.input_square == pytest.approx(144.0)
    assert found.current_A({}) == pytest.approx(4.0)
    for _ in range(REST):
        found.take(tick(np.zeros(N), np.zeros(N)))
    assert found.input_square == pytest.approx(144.0 * 0.99**REST)
    assert found.current_A({}) == pytest.approx(4.0 * 0.99 ** (REST / 2))
    found.take(tick(np.full(N, 11.0), np.full(N, 1.0)))  # smaller than then, larger than what is left of it
    assert found.input_square == pytest.approx(max(121.0, 144.0 * 0.99 ** (REST + 1)))
    found.take(tick(np.full(N, 24.0), np.full(N, 9.0)))
    assert found.input_square == pytest.approx(576.0)
    assert found.current_A({}) == pytest.approx(9.0)


def test_rms_not_peak() -> None:
    found = levels()
    square_wave = np.where(np.arange(N) % 2 == 0, 6.0, 0.0)
    found.take(tick(square_wave, square_wave / 3))
    assert found.input_square == pytest.approx(18.0)
    assert found.current_A({}) == pytest.approx(math.sqrt(2.0))


def test_steps_between_samples() -> None:
    """Of the input the larger is remembered; of the current only the last tick counts."""
    found = levels()
    found.take(tick(2.0 * np.arange(N), 0.5 * np.arange(N)))
    assert found.input_step_square == pytest.approx(4.0)
    assert found.current_step_square == pytest.approx(0.25)
    found.take(tick(np.full(N, 50.0), np.full(N, 7.0)))
    assert found.input_step_square == pytest.approx(4.0 * 0.99)
    assert found.current_step_square == 0.0


def test_without_a_current_sensor_ohms_law() -> None:
    found = levels()
    found.take(tick(np.full(N, 6.0)))
    assert found.current_A({"R": 2.0}) == pytest.approx(3.0)
    assert found.torque_Nm({"R": 2.0, "K": 0.5}) == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("drive", "values", "torque_Nm"), [("voltage", {"K": 0.5}, 2.0), ("current", {"K": 0.5}, 2.0), ("torque", {}, 3.0)]
)
def test_torque_by_what_drives_the_motor(drive: Drive, values: dict[str, float], torque_Nm: float) -> None:
    found = levels(drive)
    found.take(tick(np.full(N, 24.0), np.full(N, 4.0), np.full(N, 3.0) if drive == "torque" else None))
    assert found.torque_Nm(values) == pytest.approx(torque_Nm)


def test_one_unit_of_each_parameter() -> None:
    """1 for logarithms and angles, the typical torque or current for what has their units."""
    plant = build_plant((*OFFSETS, "gravity_load"))
    found = Levels(plant)
    found.take(tick(np.full(N, 24.0), np.full(N, 4.0)))
    scales = dict(zip(plant.parameter_names, found.scales({"K": 0.5, "R": 1.0}), strict=True))
    signed = {p.name for p in plant.parameters if p.transform != "log"}
    assert {"TL", "i0", "phi_g"} <= signed and {"R", "L", "K", "J", "B"}.isdisjoint(signed)
    assert scales["TL"] == pytest.approx(2.0)
    assert scales["i0"] == pytest.approx(4.0)
    assert scales["phi_g"] == 1.0
    assert all(scales[name] == 1.0 for name in scales.keys() - signed)


@pytest.mark.parametrize("drive", ["voltage", "current", "torque"])
def test_scales_are_never_zero(drive: Drive) -> None:
    """Before the first sample, with nothing but zeros, and with a tick without any sample."""
    effects = OFFSETS if drive == "voltage" else OFFSETS[:1]
    found = levels(drive, effects)
    nothing = np.zeros(0)
    zeros = np.zeros(N)
    empty = Stretch(nothing, np.zeros(0, dtype=bool), nothing, nothing, nothing, nothing, None)
    for stretch in (None, tick(zeros, zeros, zeros), empty):
        if stretch is not None:
            found.take(stretch)
        scales = np.array(found.scales({}))
        assert (scales > 0.0).all() and np.isfinite(scales).all()
        assert np.isfinite(1.0 / scales**2).all(), "the excitation divides by their squares"
