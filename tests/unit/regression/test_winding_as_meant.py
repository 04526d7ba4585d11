"""What no row of the winding's balance can show, in its standard deviations."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.regression.winding.estimate import WindingEstimate, as_meant
from servo_daemon.signal_meaning import SignalMeaning

FOUND = WindingEstimate(
    ("R", "L", "K", "v0"), np.array([2.0, 1e-3, 0.05, 0.1]), np.diag([1e-4, 1e-10, 1e-10, 1e-6]), 0.0, 0.01
)


def test_a_factor_of_the_whole_voltage_is_one_of_r_l_and_k() -> None:
    meant = as_meant(FOUND, SignalMeaning("mean", voltage_scale_std=0.01), 1e-3)
    assert meant.of("K") == pytest.approx((0.05, np.hypot(1e-5, 5e-4)))
    assert meant.of("R") == pytest.approx((2.0, np.hypot(1e-2, 2e-2)))
    assert meant.covariance[0, 2] == pytest.approx(1e-4 * 2.0 * 0.05), "one factor of both"
    assert meant.of("v0") == FOUND.of("v0"), "an offset is not scaled by what is measured beside it"


def test_between_instants_there_is_no_inductance() -> None:
    assert as_meant(FOUND, SignalMeaning("instant"), 1e-3).names == ("R", "K", "v0")
    assert "L" in as_meant(FOUND, SignalMeaning("instant"), 1e-5).names
