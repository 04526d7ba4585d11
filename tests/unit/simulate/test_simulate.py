"""The simulated drive: reproducible, the same however it is asked for, and with the sensors it says it has."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64, Quality, SampleBlock, concatenate
from servo_daemon.simulate import (
    DEFAULT_AGEING,
    DEFAULT_J_M,
    DEFAULT_NOMINAL,
    PAPER_MOTOR,
    SimulatedDrive,
    make_settings,
    simulate_capture,
)
from servo_daemon.simulate.drive import CHUNK

PERFECT: dict[str, Any] = {
    "counts_per_rev": 0, "current_bits": 0, "current_range_A": 0, "current_noise_A": 0, "voltage_lsb_V": 0,
    "jitter_s": 0, "time_lsb_s": 0, "velocity_noise_rad_s": 0,
    "channels": ["voltage_V", "current_A", "position_rad", "velocity_rad_s"],
}  # fmt: skip
LIVELY: dict[str, Any] = {
    "effects": ["coulomb_friction:Tc=0.3", "winding_heating"],
    "ageing": ["R=+10%/5s", "K=2%/sqrt(min)", "J_d=+0.001@2s"],
    "J_m": DEFAULT_J_M,
    "sensors": {"voltage_noise_V": 0.01, "hidden_voltage_V": 0.1, "position_noise_rad": 1e-4, "jitter_s": 2e-4},
}


def drive(**settings: Any) -> SimulatedDrive:
    return SimulatedDrive(make_settings(**settings))


def arrays(block: SampleBlock) -> dict[str, F64]:
    return {name: getattr(block, name) for name in ("time_s", "sequence", "quality", *block.channels)}


def assert_same(a: SampleBlock, b: SampleBlock) -> None:
    assert arrays(a).keys() == arrays(b).keys()
    for name, values in arrays(a).items():
        np.testing.assert_array_equal(values, arrays(b)[name], err_msg=name)


@pytest.mark.parametrize("sizes", [[1] * 50, [7] * 400, [CHUNK], [CHUNK - 1, 1, 1, CHUNK + 1], [3000], [5, 2500, 1]])
def test_samples_do_not_depend_on_how_they_are_asked_for(sizes: list[int]) -> None:
    parts, whole = drive(**LIVELY), drive(**LIVELY)
    assert_same(concatenate([parts.next_block(n) for n in sizes]), whole.next_block(sum(sizes)))
    assert parts.truth() == whole.truth()
    assert parts.true_state() == whole.true_state()


def test_same_seed_same_samples_other_seed_others() -> None:
    assert_same(drive(**LIVELY).next_block(2000), drive(**LIVELY).next_block(2000))
    other = drive(**LIVELY, seed=1).next_block(2000)
    assert not np.array_equal(drive(**LIVELY).next_block(2000).current_A, other.current_A)


def test_machine_and_c_simulate_the_same() -> None:
    settings = make_settings(**LIVELY)
    assert_same(SimulatedDrive(settings, compiled=False).next_block(1500), SimulatedDrive(settings).next_block(1500))


def test_one_noise_does_not_disturb_another() -> None:
    """Switching the voltage's noise on leaves the current's as it was (streams of their own)."""
    plain = drive(sensors={"jitter_s": 0}).next_block(2000)
    noisy = drive(sensors={"jitter_s": 0, "voltage_noise_V": 0.1, "position_noise_rad": 1e-3}).next_block(2000)
    np.testing.assert_array_equal(plain.current_A, noisy.current_A)
    assert not np.array_equal(plain.voltage_V, noisy.voltage_V)


def test_the_record_replays_to_its_noise() -> None:
    """The recorded voltage through the plant gives the recorded current and angle back, to noise and resolution."""
    block, _ = simulate_capture(seconds=20.0)
    residual_A, residual_rad = free_run(block, np.array(list(PAPER_MOTOR.values())))
    assert np.std(residual_A) == pytest.approx(0.003 * 0.4 * 24 / PAPER_MOTOR["R"], rel=0.03)
    assert abs(np.mean(residual_A)) < 0.002
    assert np.std(residual_rad) == pytest.approx(2 * np.pi / 8192 / np.sqrt(12), rel=0.1)


def free_run(block: SampleBlock, p: F64) -> tuple[F64, F64]:
    """Recorded minus simulated current (A) and angle (rad), from rest."""
    model = build_plant(())
    x, c, row = ca.SX.sym("x", 3), ca.SX.sym("c", 5), ca.SX.sym("row", 3)
    loop = SampleLoop(ca.Function("step", [x, c, row], [model.step(x, row[2], c, row[0], row[1]), x]))
    assert block.voltage_V is not None
    rows = np.column_stack([block.time_s[:-1], np.diff(block.time_s), block.voltage_V[:-1]])
    out = loop.run(np.zeros(3), p, rows)
    assert block.current_A is not None
    assert block.position_rad is not None
    return block.current_A[:-1] - out[:, 0], block.position_rad[:-1] - out[:, 2]


@pytest.mark.parametrize("effect", ["coulomb_friction", "constant_load_torque", "gravity_load", "winding_heating"])
def test_effects_without_values_show_on_the_default_motor(effect: str) -> None:
    """The linear motor with the true R, L, K, J, B misses the current by at least three times the noise (0.058 A)."""
    block, _ = simulate_capture(seconds=30.0, effects=[effect])
    residual_A, _ = free_run(block, np.array(list(PAPER_MOTOR.values())))
    assert np.sqrt(np.mean(residual_A**2)) > 3 * 0.058


def test_the_default_motion_tells_every_parameter() -> None:
    """Fisher information of 10 s: each parameter to better than 0.3 % (1 σ), with everything else unknown."""
    block, _ = simulate_capture(seconds=10.0)
    p = np.array(list(PAPER_MOTOR.values()))
    scaled = []
    for k in range(5):
        d = 1e-5 * (np.arange(5) == k)
        above, below = free_run(block, p * np.exp(d)), free_run(block, p * np.exp(-d))
        slopes = [(b - a) / 2e-5 for a, b in zip(above, below, strict=True)]
        scaled.append(np.concatenate([slopes[0] / 0.06, slopes[1] / (2 * np.pi / 8192 / np.sqrt(12))]))
    covariance = np.linalg.inv(np.array(scaled) @ np.array(scaled).T)
    assert np.all(np.sqrt(np.diag(covariance)) < 0.003)


def test_resolutions_are_those_of_the_info() -> None:
    source = drive()
    info, block = source.info, source.next_block(3000)
    for values, lsb in [
        (block.current_A, info.current_lsb_A),
        (block.voltage_V, info.voltage_lsb_V),
        (block.position_rad, 2 * np.pi / (info.counts_per_rev or 0)),
        (block.time_s, 1e-6),
    ]:
        assert values is not None
        assert lsb
        np.testing.assert_allclose(values, np.rint(values / lsb) * lsb, rtol=0, atol=1e-9 * lsb)
        assert len(np.unique(values)) > 100
    assert info.channels == block.channels == ("voltage_V", "current_A", "position_rad")
    assert info.sample_period_s == 1e-3


def test_jitter_stays_within_its_bounds_and_time_increases() -> None:
    block = drive(sensors={"jitter_s": 4e-4, "time_lsb_s": 0}).next_block(5000)
    off = block.time_s - np.arange(5000) * 1e-3
    assert np.max(np.abs(off)) <= 4e-4
    assert np.std(off) == pytest.approx(4e-4 / np.sqrt(3), rel=0.05)
    assert np.all(np.diff(block.time_s) > 0)
    assert np.array_equal(block.sequence, np.arange(5000))


def test_perfect_sensors_show_the_state() -> None:
    source = drive(sensors=PERFECT)
    for n in (1, 700, 5000):
        block, state = source.next_block(n), source.true_state()
        for shown, true in [("current_A", "current_A"), ("position_rad", "position_rad")]:
            assert getattr(block, shown)[-1] == state[true]
        assert block.velocity_rad_s is not None
        assert block.velocity_rad_s[-1] == state["velocity_rad_s"]


def test_limits_are_flagged() -> None:
    """A weak converter clips and a weak supply saturates; both say so."""
    clipped = drive(sensors={"current_range_A": 10.0}).next_block(4000)
    assert clipped.current_A is not None
    assert np.max(np.abs(clipped.current_A)) <= 10.0 + 1e-9
    at_limit = np.abs(clipped.current_A) >= 10.0 - 1e-9
    assert at_limit.any()
    assert np.all(clipped.quality[at_limit] == Quality.SATURATED)
    assert np.all(clipped.quality[np.abs(clipped.current_A) < 9.9] == Quality.GOOD)
    weak = drive(supply_V=5.0, dither_rms_V=3.0).next_block(4000)
    assert weak.voltage_V is not None
    full = np.abs(weak.voltage_V) >= 5.0
    assert full.any()
    assert np.array_equal(full, weak.quality == Quality.SATURATED)
    assert np.max(np.abs(weak.voltage_V)) == 5.0


def test_hidden_voltage_is_not_in_the_record() -> None:
    quiet = drive(motion="rest", sensors=PERFECT).next_block(2000)
    moved = drive(motion="rest", sensors={**PERFECT, "hidden_voltage_V": 0.5}).next_block(2000)
    assert quiet.current_A is not None
    assert moved.current_A is not None
    assert not quiet.current_A.any()
    assert np.std(moved.current_A) > 0.05


def test_truth_follows_the_ageing_to_the_last_delivered_sample() -> None:
    source = drive(ageing=["R=+40%/10s", "J_d=+0.003@2s"], J_m=0.009, sensors={"jitter_s": 0})
    assert source.truth()["R"] == PAPER_MOTOR["R"]
    source.next_block(1001)  # the last one at 1 s
    assert source.truth()["R"] == pytest.approx(PAPER_MOTOR["R"] * 1.04, rel=1e-12)
    assert source.truth()["J_d"] == pytest.approx(PAPER_MOTOR["J"] - 0.009)
    source.next_block(1000)
    assert source.truth()["J_d"] == pytest.approx(PAPER_MOTOR["J"] - 0.009 + 0.003)
    assert source.truth()["J"] == pytest.approx(PAPER_MOTOR["J"] + 0.003)


def test_without_motor_inertia_there_is_no_load_inertia() -> None:
    assert set(drive(effects=["gravity_load"]).truth()) == {"R", "L", "K", "J", "B", "Tg", "phi_g"}


def test_the_daemons_first_guess_is_30_to_50_percent_off() -> None:
    for name, value in PAPER_MOTOR.items():
        assert 0.3 <= abs(DEFAULT_NOMINAL[name] / value - 1) <= 0.5
    assert DEFAULT_NOMINAL["J_m"] == DEFAULT_J_M < PAPER_MOTOR["J"]


def test_default_ageing_is_visible_and_stays_a_motor_for_days() -> None:
    ageing = make_settings(ageing=DEFAULT_AGEING, J_m=DEFAULT_J_M).ageing
    start = ageing.values(np.zeros(1))[0]
    after = ageing.values(np.array([600.0, 3600.0, 3 * 86400.0])) / start
    assert np.all(np.abs(after[0] - 1) > 0.015)  # ten minutes: each has changed visibly
    assert np.all((after > 0.4) & (after < 2.5))


@pytest.mark.parametrize("rate_hz", [50.0, 190.0, 10_000.0])
def test_other_rates_and_motors(rate_hz: float) -> None:
    """A small fast motor, nothing else said: sensors, gains and motion fit it."""
    motor = {"R": 1.2, "L": 1e-3, "K": 0.05, "J": 2e-5, "B": 1e-5}
    source = drive(motor=motor, rate_hz=rate_hz)
    block = source.next_block(int(20 * rate_hz))
    assert block.current_A is not None
    assert block.position_rad is not None
    assert 0.05 < np.std(block.current_A) < 20
    assert np.ptp(block.position_rad) > 3
    assert np.mean(block.quality != 0) < 0.2
    assert block.time_s[-1] == pytest.approx(20, abs=2 / rate_hz)


def test_a_block_has_at_least_one_sample() -> None:
    with pytest.raises(ValueError, match="at least one"):
        drive().next_block(0)


def test_identity_is_that_of_the_settings() -> None:
    assert drive().info.identity == drive().info.identity
    assert len({drive(seed=s, ageing=a).info.identity for s in (0, 1) for a in ((), ("R=+1%/s",))}) == 4
