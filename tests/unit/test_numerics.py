"""Medians and least squares against NumPy's."""

from __future__ import annotations

import numpy as np

from servo_daemon.numerics import STD_OF_MEDIAN, least_squares, median, upper_median, white_noise_var


def test_medians_are_numpys() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 10, 101, 200):
        values = rng.normal(size=n)
        assert median(values) == np.median(values)
        assert upper_median(values) == np.sort(values)[n // 2]


def test_noise_on_a_smooth_signal() -> None:
    rng = np.random.default_rng(1)
    noise = 0.02 * rng.normal(size=20_000)
    signal = 5 * np.sin(np.arange(20_000) / 300)
    assert abs(white_noise_var(signal + noise) / 0.02**2 - 1) < 0.05
    assert abs(STD_OF_MEDIAN * median(np.abs(noise)) / 0.02 - 1) < 0.03
    assert white_noise_var(np.ones(7)) == 0.0


def test_columns_of_any_size() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(50, 3)) * [1e-9, 1.0, 1e12]
    wanted = np.array([3e9, -2.0, 5e-12])
    found, rank = least_squares(A, A @ wanted)
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    assert rank == 3
    found, rank = least_squares(np.column_stack([A[:, 1], A[:, 1], np.zeros(50)]), 2 * A[:, 1])
    np.testing.assert_allclose(found, [1.0, 1.0, 0.0], atol=1e-12)
    assert rank == 1
