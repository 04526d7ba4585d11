"""Short windows integrate polynomials exactly, whatever their samples' jitter."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from servo_daemon.regression.modulating import make_windows

PHI = 1024.0 * Polynomial([0.0, 1.0, -1.0]) ** 5


@pytest.mark.parametrize("jitter", [0.0, 0.2])
@pytest.mark.parametrize("power", range(5))
def test_polynomials_are_integrated_exactly(jitter: float, power: int) -> None:
    """The window of 0.12 s that a drive of 100 Hz has. Without the correction an angle of one radian is an acceleration
    of 0.5 rad/s² there."""
    t = 0.01 * (np.arange(40) + np.random.default_rng(2).uniform(-jitter, jitter, 40))
    w = make_windows(t, np.array([3, 9, 20]), 13, exact=True)
    for derivative in range(3):
        for got, a in zip(w.integral(t**power, derivative), t[w.first], strict=True):
            span = t[np.searchsorted(t, a) + 12] - a
            whole = (PHI.deriv(derivative) if derivative else PHI) * Polynomial([a, span]) ** power
            exact = (whole.integ()(1.0) - whole.integ()(0.0)) * span ** (1 - derivative)
            assert got == pytest.approx(exact, abs=1e-9)


def test_a_window_with_a_gap_is_left_alone() -> None:
    t = np.concatenate([0.01 * np.arange(8), 5.0 + 0.01 * np.arange(30)])
    first = np.array([2, 12])
    plain, exact = (make_windows(t, first, 13, exact=e).weights for e in (False, True))
    np.testing.assert_array_equal(plain[:, 0], exact[:, 0])
    assert not np.array_equal(plain[:, 1], exact[:, 1])
