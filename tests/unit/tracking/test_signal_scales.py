"""How large the signals are: the larger remembered, and a unit for every parameter that is never zero."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.plant.build import Drive, build_plant
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64
from servo_daemon.tracking.samples.signal_scales import SignalScales

OFFSETS = ("constant_load_torque", "current_sensor_offset")
N = 100
#: Ticks of nothing: 2 s.
REST = 20


def tick(voltage: F64 | None = None, current: F64 | None = None, torque: F64 | None = None) -> Stretch:
    return Stretch(np.arange(N) * 1e-3, np.ones(N, dtype=bool), voltage, current, torque, np.zeros(N), None)


def scales_of(drive: Drive = "voltage", effects: tuple[str, ...] = ()) -> SignalScales:
    return SignalScales(build_plant(effects, drive))


def take(found: SignalScales, stretch: Stretch, position_lsb: float = 0.0, current_var: float = 0.0) -> None:
    found.take(stretch, 1e-3, position_lsb, {"current_A": current_var})


def test_the_larger_is_remembered() -> None:
    """Up at once; down by 1 % of the square a tick, so that a rest of 2 s is no smaller motor."""
    found = scales_of()
    take(found, tick(np.full(N, 3.0), np.full(N, 1.0)))
    take(found, tick(np.full(N, 12.0), np.full(N, -4.0)))
    assert found.input_square == pytest.approx(144.0)
    assert found.current_A({}) == pytest.approx(4.0)
    for _ in range(REST):
        take(found, tick(np.zeros(N), np.zeros(N)))
    assert found.input_square == pytest.approx(144.0 * 0.99**REST)
    assert found.current_A({}) == pytest.approx(4.0 * 0.99 ** (REST / 2))
    take(found, tick(np.full(N, 11.0), np.full(N, 1.0)))  # smaller than then, larger than what is left of it
    assert found.input_square == pytest.approx(max(121.0, 144.0 * 0.99 ** (REST + 1)))
    take(found, tick(np.full(N, 24.0), np.full(N, 9.0)))
    assert found.input_square == pytest.approx(576.0)
    assert found.current_A({}) == pytest.approx(9.0)


def test_rms_not_peak() -> None:
    found = scales_of()
    square_wave = np.where(np.arange(N) % 2 == 0, 6.0, 0.0)
    take(found, tick(square_wave, square_wave / 3))
    assert found.input_square == pytest.approx(18.0)
    assert found.current_A({}) == pytest.approx(math.sqrt(2.0))


def test_steps_between_samples() -> None:
    """Of the input the larger is remembered; of the current what the last seconds showed counts, lively ticks and quiet
    ones alike: one of them may happen to be quiet, or the first of a rest."""
    found = scales_of()
    take(found, tick(2.0 * np.arange(N), 0.5 * np.arange(N)))
    assert found.input_step_square == pytest.approx(4.0)
    assert found.current_step_square == pytest.approx(0.25)
    take(found, tick(np.full(N, 50.0), np.full(N, 7.0)))
    assert found.input_step_square == pytest.approx(4.0 * 0.99)
    assert found.current_step_square == pytest.approx(0.125)


def test_a_few_wrong_samples_are_spikes_and_change_nothing_of_what_a_spike_is() -> None:
    """Far beyond the largest change but for theirs; nothing is one before there is anything to compare with."""
    rng, found = np.random.default_rng(1), scales_of()
    assert found.spike_limit == found.current_spike_limit == math.inf
    noise = rng.normal(size=N)
    take(found, tick(10.0 * noise, noise))
    usual = found.current_spike_limit
    assert 1.0 * np.abs(np.diff(noise)).max() < usual < 4.0 * np.abs(np.diff(noise)).max()
    assert found.spike_limit == pytest.approx(10.0 * usual)
    spiky = noise.copy()
    spiky[[20, 60]] += 100.0
    take(found, tick(10.0 * noise, spiky))
    assert usual <= found.current_spike_limit <= 4.0 * np.abs(np.diff(noise)).max()
    take(found, tick(10.0 * noise, 3.0 * noise))
    assert found.current_spike_limit == pytest.approx(3.0 * usual)


def test_without_a_current_sensor_ohms_law() -> None:
    found = scales_of()
    take(found, tick(np.full(N, 6.0)))
    assert found.current_A({"R": 2.0}) == pytest.approx(3.0)
    assert found.torque_Nm({"R": 2.0, "K": 0.5}) == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("drive", "values", "torque_Nm"), [("voltage", {"K": 0.5}, 2.0), ("current", {"K": 0.5}, 2.0), ("torque", {}, 3.0)]
)
def test_torque_by_what_drives_the_motor(drive: Drive, values: dict[str, float], torque_Nm: float) -> None:
    found = scales_of(drive)
    take(found, tick(np.full(N, 24.0), np.full(N, 4.0), np.full(N, 3.0) if drive == "torque" else None))
    assert found.torque_Nm(values) == pytest.approx(torque_Nm)


def test_one_unit_of_each_parameter() -> None:
    """1 for logarithms and angles, the typical torque or current for what has their units."""
    plant = build_plant((*OFFSETS, "gravity_load"))
    found = SignalScales(plant)
    take(found, tick(np.full(N, 24.0), np.full(N, 4.0)))
    scales = dict(zip(plant.parameter_names, found.scales({"K": 0.5, "R": 1.0}), strict=True))
    signed = {p.name for p in plant.parameters if p.transform != "log"}
    assert {"TL", "i0", "phi_g"} <= signed and {"R", "L", "K", "J", "B"}.isdisjoint(signed)
    assert scales["TL"] == pytest.approx(2.0)
    assert scales["i0"] == pytest.approx(4.0)
    assert scales["phi_g"] == 1.0
    assert all(scales[name] == 1.0 for name in scales.keys() - signed)


@pytest.mark.parametrize(("period_s", "seen"), [(0.01, True), (0.002, False)])
def test_a_slow_input_is_off_its_samples_in_one_tick_and_in_ticks_judged_together(period_s: float, seen: bool) -> None:
    """A torque that jumps: its mean between samples is off the straight line. At 500 Hz that is no matter."""
    n = 50  # five ticks of ten samples
    torque = np.where(np.arange(n) // 9 % 2, 1.0, -1.0)
    stretch = Stretch(period_s * np.arange(n), np.ones(n, dtype=bool), None, None, torque, np.zeros(n), None)
    found = scales_of("torque")
    found.take(stretch, period_s, 0.0, {})
    assert (found.unseen_square > 0.01) is seen


@pytest.mark.parametrize("drive", ["voltage", "current", "torque"])
def test_scales_are_never_zero(drive: Drive) -> None:
    """Before the first sample, with nothing but zeros, and with a tick without any sample."""
    effects = OFFSETS if drive == "voltage" else OFFSETS[:1]
    found = scales_of(drive, effects)
    nothing = np.zeros(0)
    zeros = np.zeros(N)
    empty = Stretch(nothing, np.zeros(0, dtype=bool), nothing, nothing, nothing, nothing, None)
    for stretch in (None, tick(zeros, zeros, zeros), empty):
        if stretch is not None:
            take(found, stretch)
        scales = np.array(found.scales({}))
        assert (scales > 0.0).all() and np.isfinite(scales).all()
        assert np.isfinite(1.0 / scales**2).all(), "the excitation divides by their squares"


@pytest.mark.parametrize(
    ("counts", "noise_A", "rests"), [(0, 0.1, True), (1, 0.1, True), (0, 1.0, False), (40, 0.1, False)]
)
def test_a_drive_rests_where_neither_encoder_nor_winding_shows_anything(
    counts: int, noise_A: float, rests: bool
) -> None:
    """Between the noise of a sensor (0.1 A) and ten times as much, between a flicker of one count and forty a tick."""
    rng = np.random.default_rng(1)
    position = np.round(np.linspace(0.0, counts, N)) * 1e-3
    stretch = replace(tick(np.zeros(N), 2.0 + noise_A * rng.standard_normal(N)), position=position)
    found = scales_of()
    take(found, tick(np.full(N, 12.0), np.full(N, 4.0)), 1e-3, 0.01)
    take(found, stretch, 1e-3, 0.01)
    assert found.rests is rests
    assert (found.input_square == pytest.approx(144.0)) is rests, "a rest is no smaller motor"
