"""A step with so few points that a slow winding leaves no trace of its own."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error import OutputErrorFit, Recording, fit_output_error
from servo_daemon.samples import make_block

GAIN, VOLTAGE, NOISE = 0.9, 8.0, 0.04


def step(fast_s: float, slow_s: float, seed: int) -> OutputErrorFit:
    """12 points 50 ms apart of the exact answer to a step, with two real poles."""
    t = 0.05 * np.arange(12)
    answer = 1.0 - (slow_s * np.exp(-t / slow_s) - fast_s * np.exp(-t / fast_s)) / (slow_s - fast_s)
    speed = GAIN * VOLTAGE * answer + NOISE * np.random.default_rng(seed).standard_normal(12)
    speed[0] = 0.0
    return fit_output_error([Recording("step", make_block(t, voltage_V=np.full(12, VOLTAGE), velocity_rad_s=speed))])


@pytest.mark.parametrize(("fast_s", "slow_s", "most"), [(0.0055, 0.012, 0.7), (0.001, 0.04, 0.1)])
def test_a_time_constant_holds_the_lag_that_a_winding_may_have(fast_s: float, slow_s: float, most: float) -> None:
    for seed in (2, 3, 4):
        fit = step(fast_s, slow_s, seed)
        found = {c.expression: c for c in fit.combinations}
        assert found["K/(B R + K²)"].value == pytest.approx(GAIN, rel=0.01)
        lag = found.get("(J R + L B)/(B R + K²)")
        if most < 0.5:
            assert lag is not None
        assert lag is None or abs(lag.value - (fast_s + slow_s)) < 3.0 * lag.std < 3.0 * most * lag.value
