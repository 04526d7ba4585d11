"""What a capture's numbers say against its columns, on balances written down: no motor is simulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.captures import Capture
from servo_daemon.captures.columns.plausible import check_time_unit, plausibility_notes
from servo_daemon.captures.meaning import (
    closes_as_it_stands,
    findings,
    may_be_driven,
    no_sign_of_current,
    no_sign_of_voltage,
    restored_current,
    turned_voltage,
    without_unusable,
)
from servo_daemon.captures.meaning.restored import Shown
from servo_daemon.errors import CaptureError

R, K, J = 1.1, 0.03, 2e-5


def balanced() -> Capture:
    """A motion of a few sines at 1 kHz with the current and voltage that it needs."""
    t = np.arange(4000) * 1e-3
    parts = [(a, 2 * np.pi * f) for a, f in ((150.0, 0.7), (80.0, 2.3), (25.0, 5.9))]
    speed = sum(a * np.sin(w * t) for a, w in parts)
    angle = sum(a / w * (1 - np.cos(w * t)) for a, w in parts)
    current = np.asarray(J / K * sum(a * w * np.cos(w * t) for a, w in parts) + 0.1 * np.sign(speed))
    noise = np.random.default_rng(5).normal(0.0, 0.01, (2, len(t)))
    voltage = R * current + K * speed
    v, i, x = (np.asarray(s, np.float64) for s in (voltage + noise[0], current + noise[1], angle))
    return Capture(Path("log.csv"), np.asarray(t, np.float64), v, i, x)


def test_a_current_at_the_end_of_its_sensors_range_counts_as_not_measured() -> None:
    capture = balanced()
    assert capture.current_A is not None
    limit = 0.5 * float(np.max(np.abs(capture.current_A)))
    clipped = replace(capture, current_A=np.clip(capture.current_A, -limit, limit))
    (found,) = findings(clipped)
    assert found.column == "current_A" and found.weight == "samples" and "mend:" in found.text
    usable = without_unusable(clipped, [found])
    assert usable.current_known is not None
    np.testing.assert_array_equal(~usable.current_known, np.abs(capture.current_A) >= limit)


def test_a_current_that_the_drive_holds_at_its_limit_is_measured() -> None:
    capture = balanced()
    assert capture.current_A is not None and capture.voltage_V is not None
    limit = 0.5 * float(np.max(np.abs(capture.current_A)))
    held = np.clip(capture.current_A, -limit, limit)
    assert not findings(replace(capture, current_A=held, voltage_V=capture.voltage_V + R * (held - capture.current_A)))
    assert not findings(capture)


def test_a_voltage_without_its_sign_is_not_a_turned_angle() -> None:
    capture = balanced()
    assert capture.voltage_V is not None
    note = no_sign_of_voltage(replace(capture, voltage_V=np.abs(capture.voltage_V)))
    assert note is not None and no_sign_of_voltage(capture) is None
    assert "voltage_V never goes below zero" in note
    turned = '{ formula = "(Value) * (1 - 2 * Direction)", Value = "voltage_V", Direction = "dir" }'
    assert f"voltage_V = {turned}" in note


def test_a_turned_voltage_is_named_once_and_not_as_two_turned_answers() -> None:
    capture = balanced()
    assert capture.voltage_V is not None
    (note,) = plausibility_notes(replace(capture, voltage_V=-capture.voltage_V))
    assert 'voltage_V = { signal = "voltage_V", scale = -1 }' in note


def test_a_duty_whose_middle_stands_still_is_named_with_its_middle() -> None:
    capture = balanced()
    assert capture.voltage_V is not None
    shown = {"signal": "duty", "scale": 12.0}
    duty = replace(capture, voltage_V=6.0 + capture.voltage_V / 2.0, as_map={"signals": {"voltage_V": shown}})
    (found,) = findings(duty)
    assert found.column == "voltage_V" and found.weight == "column" and "locked antiphase" in found.text
    assert 'voltage_V = { formula = "(Value - 6) * 2", Value = { signal = "duty", scale = 12 } }' in found.text
    (found,) = findings(replace(capture, voltage_V=12.0 + capture.voltage_V))
    assert "a voltage with an offset" in found.text and '"(Value - 12) * 1"' in found.text


def test_a_duty_whose_middle_stands_still_needs_no_current() -> None:
    capture = replace(balanced(), current_A=None)
    assert capture.voltage_V is not None
    shown = {"signals": {"voltage_V": {"signal": "pwm", "scale": 24.0 / 255}}}
    (found,) = findings(replace(capture, voltage_V=12.0 + capture.voltage_V / 2.0, as_map=shown))
    assert found.weight == "column" and '"(Value - 12) * 2"' in found.text
    assert not findings(replace(capture, voltage_V=10.0 + capture.voltage_V / 2.0, as_map=shown))


def test_a_load_that_pulls_one_way_gives_the_voltage_no_middle() -> None:
    capture = balanced()
    assert capture.voltage_V is not None and capture.current_A is not None
    assert not findings(replace(capture, voltage_V=R * 8.0 + capture.voltage_V, current_A=8.0 + capture.current_A))


def test_columns_of_voltage_and_current_that_are_exchanged_are_refused() -> None:
    capture = balanced()
    (found,) = findings(replace(capture, voltage_V=capture.current_A, current_A=capture.voltage_V))
    assert found.weight == "capture" and "exchanged" in found.text


def test_a_modulus_of_a_blocked_rotor_needs_no_motion() -> None:
    capture = balanced()
    assert capture.current_A is not None and capture.voltage_V is not None
    held = replace(capture, voltage_V=R * capture.current_A, position_rad=None)
    assert not findings(held)
    (found,) = findings(replace(held, current_A=np.abs(capture.current_A)))
    assert found.column == "current_A" and '{ signal = "current_A", shows = "magnitude" }' in found.text
    shown, _ = restored_current(Shown("magnitude"), held.time_s, R * capture.current_A, np.abs(capture.current_A), None)
    large = np.abs(capture.current_A) > 0.05
    np.testing.assert_allclose(shown[large], capture.current_A[large])


def test_a_motor_that_is_driven_has_no_turned_current() -> None:
    capture = balanced()
    assert capture.position_rad is not None and capture.current_A is not None
    speed = np.gradient(capture.position_rad, capture.time_s)
    current = -K * speed / (R + 1.0) * (1.0 + 0.5 * np.sin(7.0 * capture.time_s))
    driven = replace(capture, current_A=current, voltage_V=R * current + K * speed)
    assert closes_as_it_stands(driven) and may_be_driven(driven, "current_A")
    assert closes_as_it_stands(capture) and not may_be_driven(
        replace(capture, current_A=-capture.current_A), "current_A"
    )


def test_without_signs_of_current_and_speed_the_voltage_is_not_turned() -> None:
    capture = balanced()
    assert capture.position_rad is not None and capture.current_A is not None and capture.voltage_V is not None
    speed = np.abs(np.gradient(capture.position_rad, capture.time_s))
    shown = replace(capture, current_A=np.abs(capture.current_A), position_rad=None, velocity_rad_s=speed)
    assert no_sign_of_current(shown) and not no_sign_of_current(capture)
    for sign in (1.0, -1.0):
        assert turned_voltage(replace(shown, voltage_V=sign * capture.voltage_V - 0.5)) is None


def test_what_turns_while_nothing_is_recorded_is_no_counter_that_starts_again() -> None:
    capture = balanced()
    assert capture.position_rad is not None
    late = np.arange(len(capture)) >= 2000
    paused = replace(capture, time_s=capture.time_s + 30.0 * late, position_rad=capture.position_rad + 900.0 * late)
    assert not findings(paused)
    (found,) = findings(replace(paused, time_s=capture.time_s))
    assert found.weight == "capture" and "starts again" in found.text


def test_a_position_that_was_set_to_zero_starts_again_wherever_it_was() -> None:
    capture = balanced()
    assert capture.position_rad is not None
    away = np.where(np.arange(len(capture)) < 2500, 0.0, 7.0)
    assert np.ptp(capture.position_rad) > 3 * 7.0
    (found,) = findings(replace(capture, position_rad=capture.position_rad - away))
    assert found.weight == "capture" and "starts again" in found.text
    wrong = np.where(np.arange(len(capture)) == 2500, 7.0, 0.0)
    assert not findings(replace(capture, position_rad=capture.position_rad - wrong))


def hoisted() -> Capture:
    """Up, held by a brake without a current, down, held: at 1 kHz, with speeds only."""
    rng = np.random.default_rng(6)
    t = np.arange(12_000) * 1e-3
    speed = np.where(t % 3.0 < 2.0, 40.0 * np.sin(np.pi * (t % 3.0) / 2.0) * np.where(t % 6.0 < 3.0, 1.0, -1.0), 0.0)
    moving = np.abs(speed) > 0.2
    current = np.where(moving, 5.0 + 0.6 * np.sign(speed) + J / K * np.gradient(speed, t), 0.0)
    noise = rng.normal(0.0, 0.01, (2, len(t)))
    i, w = (np.asarray(x, np.float64) for x in (current + noise[0], speed + noise[1]))
    return Capture(Path("log.csv"), np.asarray(t, np.float64), None, i, None, velocity_rad_s=w)


def test_what_is_recorded_under_a_brake_is_left_out_as_a_pause() -> None:
    capture = hoisted()
    assert capture.velocity_rad_s is not None and capture.current_A is not None
    (found,) = findings(capture)
    assert found.weight == "rows" and "stands 4 times" in found.text
    usable = without_unusable(capture, [found])
    assert usable.velocity_rad_s is not None and usable.current_A is not None
    assert 0.97 * 8_000 < len(usable) < 1.06 * 8_000
    assert np.mean(usable.current_A > 3.0) > 0.95
    assert np.count_nonzero(usable.quality()) == 3 + 1  # one at each pause


def test_a_load_that_the_motor_or_its_friction_holds_knows_no_brake() -> None:
    capture = hoisted()
    assert capture.velocity_rad_s is not None and capture.current_A is not None
    stands = capture.current_A < 1.0
    assert not findings(replace(capture, current_A=np.where(stands, 4.6, capture.current_A)))
    level = replace(capture, current_A=np.where(stands, 0.0, capture.current_A - 5.0))
    assert not findings(level)


def test_readings_too_slow_for_a_motor_are_refused_with_what_they_are_good_for() -> None:
    t = np.asarray(10.0 * np.arange(12), np.float64)
    slow = Capture(Path("log.csv"), t, t, t, None, velocity_rad_s=t)
    with pytest.raises(CaptureError, match=r"in milliseconds\? .*scale = 0\.001.*least squares of v = R i \+ K ω"):
        check_time_unit(slow)
    with pytest.raises(CaptureError, match=r"--rate is in Hz; .* record at 4 Hz"):
        check_time_unit(replace(slow, as_map={"signals": {"voltage_V": {"signal": "U"}}}))
