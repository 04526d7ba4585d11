"""Samples that were not measured (NaN, flagged) leave the winding's rows finite and out of the estimate."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.regression.winding.rows import winding_rows
from servo_daemon.samples import Quality, make_block
from servo_daemon.signal_meaning import SignalMeaning


@pytest.mark.parametrize("means", [True, False])
def test_a_sample_that_was_not_measured_spoils_no_row(means: bool) -> None:
    t = np.arange(200) * 0.005
    current, speed = np.sin(9.0 * t), 30.0 * np.cos(3.0 * t)
    voltage = 0.5 * current + 0.02 * speed
    quality = np.zeros(200, np.uint8)
    for at in (40, 41, 120):
        voltage[at] = current[at] = np.nan
        quality[at] = int(Quality.VOLTAGE_INVALID | Quality.CURRENT_INVALID)
    block = make_block(t, voltage_V=voltage, current_A=current, velocity_rad_s=speed, quality=quality)
    meaning = SignalMeaning(voltage="mean", current="mean") if means else SignalMeaning(voltage="instant")
    rows = winding_rows(block, meaning)
    assert rows is not None
    for part in (rows.voltage, rows.current, rows.speed, rows.current_rate, rows.other_rate, rows.voltage_rate):
        assert np.isfinite(part).all()
    left = rows.whole
    assert 0.8 < left.mean() < 1.0
    if means:  # of these the speed is the interval's, and the voltage above the instant's
        return
    np.testing.assert_allclose(rows.voltage[left], 0.5 * rows.current[left] + 0.02 * rows.speed[left], atol=2e-3)
