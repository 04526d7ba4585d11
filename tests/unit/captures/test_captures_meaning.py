"""What a capture's numbers say against its columns, on balances written down: no motor is simulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from servo_daemon.captures import Capture
from servo_daemon.captures.columns.plausible import plausibility_notes
from servo_daemon.captures.meaning import findings, no_sign_of_voltage, without_unusable

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
