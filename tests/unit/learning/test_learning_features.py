"""Features of a window: what they are, and that gaps, jitter, missing signals and bad samples hardly change them."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest

from servo_daemon.errors import BadInputError
from servo_daemon.learning.features import catalogue
from servo_daemon.learning.features.features import compute_features, transformed
from servo_daemon.samples import Quality, SampleBlock, make_block
from servo_daemon.simulate import PAPER_MOTOR, SimulatedDrive, make_settings

RATE = 1000.0


def window(seconds: float = 6.0, skip: float = 0.0, **more: object) -> SampleBlock:
    drive = SimulatedDrive(make_settings(rate_hz=RATE, **more))  # type: ignore[arg-type]
    if skip:
        drive.next_block(round(skip * RATE))
    return drive.next_block(round(seconds * RATE))


@pytest.fixture(scope="module")
def block() -> SampleBlock:
    return window()


@pytest.fixture(scope="module")
def features(block: SampleBlock) -> dict[str, float]:
    return named(block)


def named(block: SampleBlock) -> dict[str, float]:
    return dict(zip(catalogue.NAMES, compute_features(block).tolist(), strict=True))


def test_sixty_and_more_named_features_with_units() -> None:
    assert len(catalogue.NAMES) == len(set(catalogue.NAMES)) >= 60
    assert all(f.unit and f.text for f in catalogue.FEATURES)


def test_they_are_numbers_and_the_regression_is_right(features: dict[str, float]) -> None:
    assert all(np.isfinite(v) for v in features.values())
    for name, truth in PAPER_MOTOR.items():
        assert features[f"reg_{name}"] == pytest.approx(truth, rel=0.03), name
    assert abs(features["reg_Tc_share"]) < 0.01
    p = PAPER_MOTOR
    assert features["reg_tau_e"] == pytest.approx(p["L"] / p["R"], rel=0.03)
    static = p["K"] / (p["R"] * p["B"] + p["K"] ** 2)
    assert features["gain_v_w_1"] == pytest.approx(static, rel=0.15)


def test_what_the_motor_has_shows_where_it_should(features: dict[str, float]) -> None:
    rough = named(window(effects=["coulomb_friction:Tc=0.4"]))
    drop = named(window(effects=["brush_voltage_drop:Vb=1.0"]))
    assert rough["reg_Tc_share"] > 0.1 > abs(drop["reg_Tc_share"])
    assert rough["shaft_left_linear"] > 3 * rough["shaft_left"]
    assert rough["reversal_i"] > features["reversal_i"] + 0.1
    assert drop["arm_drop"] > 0.1 > abs(rough["arm_drop"])
    assert drop["arm_left"] > 3 * features["arm_left"]


def test_brushes_and_noise_bend_no_regression_where_an_axis_stands_between_its_moves() -> None:
    """At rest the noise makes the current's sign: with it in the drop's column K is 4 % off, without a drop 30 %."""
    own = {"motion": "steps", "dither_rms_V": 0.2, "sensors": {"current_noise_A": 0.045}}
    found = named(window(effects=["brush_voltage_drop:Vb=0.5"], **own))
    for name in "RLK":
        assert found[f"reg_{name}"] == pytest.approx(PAPER_MOTOR[name], rel=0.01), name
    assert found["reg_Vb_share"] * found["rms_v"] == pytest.approx(0.5, rel=0.02)
    assert found["arm_plain_K"] > 0.2
    assert abs(named(window(**own))["arm_plain_K"]) < 0.02


def test_a_motor_that_turns_one_way_has_a_regression_without_brushes() -> None:
    """Its current has one sign: an offset and a drop are the same."""
    found = named(window(motion="speed", peak_speed_rad_s=8.0, skip=1.0, dither_rms_V=1.0))
    assert found["reg_Vb_share"] == 0.0
    for name in "RLK":
        assert found[f"reg_{name}"] == pytest.approx(PAPER_MOTOR[name], rel=0.1), name


def test_what_went_wrong_once_and_what_comes_late_shows(block: SampleBlock, features: dict[str, float]) -> None:
    voltage, angle = block.voltage_V.copy(), block.position_rad.copy()  # type: ignore[union-attr]
    voltage[1000:1300] = 0.0
    angle[2500:] += 0.1
    assert named(dataclasses.replace(block, voltage_V=voltage))["arm_rejected"] > 0.1 > features["arm_rejected"]
    assert named(dataclasses.replace(block, position_rad=angle))["shaft_rejected"] > 0.1 > features["shaft_rejected"]
    late = named(dataclasses.replace(block, current_A=np.roll(block.current_A, 3)))  # type: ignore[arg-type]
    assert late["shaft_delay"] == pytest.approx(0.003, rel=0.3)
    assert abs(features["shaft_delay"]) < 0.0005


@pytest.mark.parametrize(
    ("channel", "feature"),
    [
        ("current_A", "arm_late_i"),
        ("voltage_V", "arm_late_v"),
        ("position_rad", "shaft_early"),
        ("current_A", "shaft_late"),
    ],
)
def test_the_balances_close_better_when_a_late_channel_is_moved_back(
    channel: str, feature: str, block: SampleBlock, features: dict[str, float]
) -> None:
    signal = getattr(block, channel)
    late = dataclasses.replace(block, **{channel: np.concatenate([np.full(4, signal[0]), signal[:-4]])})
    assert named(late)[feature] < -0.3 < 0.1 < features[feature]


def test_a_channel_that_shows_nothing_is_no_error(block: SampleBlock) -> None:
    for value in (0.0, 0.1, -1.0 / 3.0):
        dead = dataclasses.replace(block, voltage_V=np.full(len(block), value))
        assert not np.isinf(compute_features(dead)).any()


def test_they_do_not_depend_on_when_the_clock_began(block: SampleBlock) -> None:
    later = dataclasses.replace(block, time_s=block.time_s + 1024.0)
    assert compute_features(later) == pytest.approx(compute_features(block), rel=1e-4, abs=1e-6)


def test_jitter_and_gaps_hardly_move_them(block: SampleBlock, features: dict[str, float]) -> None:
    keep = np.ones(len(block), dtype=bool)
    keep[1500:1560] = keep[4000:4003] = False
    keep[np.random.default_rng(1).integers(0, len(block), 60)] = False
    with_gaps = named(block.select(keep))
    with_jitter = named(window(sensors={"jitter_s": 1.5e-4}))
    for other in (with_gaps, with_jitter):
        for name in ("reg_R", "reg_L", "reg_K", "reg_J", "reg_B", "gain_v_w_2", "gain_v_i_2", "rms_i", "decay_w"):
            assert other[name] == pytest.approx(features[name], rel=0.05), name


def test_time_stamps_told_twice_are_no_error(block: SampleBlock, features: dict[str, float]) -> None:
    time_s = block.time_s.copy()
    time_s[[1, 2500, -1]] = time_s[[0, 2499, -2]]
    found = named(dataclasses.replace(block, time_s=time_s))
    assert all(np.isfinite(v) for v in found.values())
    for name in ("reg_R", "reg_K", "reg_J", "rms_i", "rms_w", "gain_v_i_2"):
        assert found[name] == pytest.approx(features[name], rel=0.02), name


def test_samples_that_are_no_measurement_do_not_count(block: SampleBlock, features: dict[str, float]) -> None:
    current, quality = block.current_A.copy(), block.quality.copy()  # type: ignore[union-attr]
    current[3300:3400] = np.nan
    quality[3300:3400] |= int(Quality.CURRENT_INVALID)
    bad = named(dataclasses.replace(block, current_A=current, quality=quality))
    for name in ("reg_R", "reg_K", "reg_J", "rms_i", "kurtosis_i"):
        assert bad[name] == pytest.approx(features[name], rel=0.05), name


@pytest.mark.parametrize("lost", ["current_A", "voltage_V"])
def test_without_a_signal_the_rest_is_there(lost: str, block: SampleBlock, features: dict[str, float]) -> None:
    found = named(dataclasses.replace(block, **{lost: None}))
    kept = {"current_A": ("gain_v_w_1", "rms_v", "ratio_v_w"), "voltage_V": ("gain_i_w_1", "rms_i", "ratio_i_w")}[lost]
    gone = {"current_A": ("reg_R", "rms_i", "gain_v_i_1"), "voltage_V": ("reg_R", "rms_v", "gain_v_i_1")}[lost]
    assert all(found[n] == pytest.approx(features[n], rel=1e-9) for n in kept)
    assert all(np.isnan(found[n]) for n in gone)


def test_a_speed_in_place_of_the_angle(features: dict[str, float]) -> None:
    channels = ["voltage_V", "current_A", "velocity_rad_s"]
    found = named(window(sensors={"channels": channels}))
    for name in ("reg_R", "reg_K", "reg_J", "gain_i_w_2"):
        assert found[name] == pytest.approx(features[name], rel=0.05), name


def test_standstill_and_constant_signals_are_no_error() -> None:
    t = np.arange(3000) / RATE
    noise = np.random.default_rng(3).normal(size=3000)
    still = make_block(t, voltage_V=np.zeros(3000), current_A=noise, position_rad=np.zeros(3000))
    found = compute_features(still)
    assert not np.isinf(found).any()
    assert not np.isinf(transformed(found)).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: b.slice(0, 1000), "2 to 10 s"),
        (lambda b: dataclasses.replace(b, position_rad=None), "position_rad or velocity_rad_s"),
        (lambda b: dataclasses.replace(b, quality=np.full(len(b), 2, dtype=np.uint8)), "usable"),
        (lambda b: dataclasses.replace(b, current_A=np.ones(len(b))), "usable"),
    ],
)
def test_what_is_no_window(change: object, message: str, block: SampleBlock) -> None:
    with pytest.raises(BadInputError, match=message):
        compute_features(change(block))  # type: ignore[operator]


def test_ten_seconds_at_a_kilohertz_in_time() -> None:
    """10 ms is the goal (benchmarks/learning.py measures it); here with room for a machine that does other things."""
    long = window(10.0)
    compute_features(long)
    took = []
    for _ in range(5):
        began = time.process_time()
        compute_features(long)
        took.append(time.process_time() - began)
    assert min(took) < 0.04
