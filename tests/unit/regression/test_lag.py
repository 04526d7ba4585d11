"""A voltage behind a lag, against the differential equation."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.regression.lag import Lag


@pytest.mark.parametrize("lag_s", [1e-4, 1e-3, 2e-2])
def test_means_are_those_of_the_differential_equation(lag_s: float) -> None:
    """Held inputs, integrated in steps of a thousandth of the sample period."""
    rng = np.random.default_rng(3)
    h, shown = 1e-3, rng.standard_normal(40)
    v, fine, means = float(shown[0]), 1000, []
    for u in shown:
        inner = u + (v - u) * np.exp(-np.arange(fine + 1) * h / fine / lag_s)
        means.append(np.trapezoid(inner) / fine)
        v = float(inner[-1])
    t = h * np.arange(40)
    lag = Lag(lag_s)
    pieces = [lag.mean_of(t[a:b], shown[a:b]) for a, b in ((0, 7), (7, 25), (25, 40))]
    np.testing.assert_allclose(np.concatenate(pieces), means, atol=1e-4)


def test_a_single_sample_and_none() -> None:
    lag = Lag(1e-3)
    assert lag.mean_of(np.array([]), np.array([])).shape == (0,)
    assert np.isfinite(lag.mean_of(np.array([0.0]), np.array([2.0]))).all()
