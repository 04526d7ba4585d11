"""Many least-squares fits at once against one `lstsq` each."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.learning.features.balance_fits import Fits, fit


@pytest.fixture
def columns() -> np.ndarray:
    rng = np.random.default_rng(3)
    out = rng.normal(size=(7, 90)) * 10.0 ** rng.uniform(-6, 6, size=(7, 1))
    out[5] = 3.0 * out[0] - 0.2 * out[1] + 0.01 * rng.normal(size=90) * np.abs(out[0]).max()
    return out


def test_every_model_is_what_least_squares_says(columns: np.ndarray) -> None:
    cases = [((0, 1, 2), 5), ((0, 1), 5), ((0, 1, 2, 3, 4), 6), ((6,), 0)]
    for (own, y), found in zip(cases, Fits(list(columns)).solve(cases), strict=True):
        theta, *_ = np.linalg.lstsq(columns[list(own)].T, columns[y], rcond=None)
        left = columns[y] - theta @ columns[list(own)]
        assert found.theta * np.abs(columns[list(own)]).max(axis=1) == pytest.approx(
            theta * np.abs(columns[list(own)]).max(axis=1), rel=1e-6, abs=1e-7 * np.abs(columns[y]).max()
        )
        assert found.left == pytest.approx(np.linalg.norm(left) / np.linalg.norm(columns[y]), rel=1e-6)


def test_too_few_rows_for_one_model_are_enough_for_another(columns: np.ndarray) -> None:
    five, two = Fits(list(columns[:, :10])).solve([((0, 1, 2, 3, 4), 5), ((0, 1), 5)])
    assert np.isnan(five.theta).all()
    assert len(five.theta) == 5
    assert np.isnan(five.left)
    assert np.isfinite(two.left)


def test_columns_that_show_nothing_or_the_same_are_no_error(columns: np.ndarray) -> None:
    found = fit([columns[0], columns[0], np.zeros(90)], columns[5])
    assert found.theta[0] == pytest.approx(found.theta[1])
    assert found.theta[2] == 0.0
    assert fit([columns[0]], np.zeros(90)).left == 0.0


def test_rows_spoilt_once_are_what_is_rejected(columns: np.ndarray) -> None:
    spoilt = columns[5].copy()
    spoilt[40:43] += 10.0 * np.abs(spoilt).max()
    fits = Fits([*columns[:2], spoilt, columns[5]])
    share = np.linalg.norm(spoilt[40:43]) / np.linalg.norm(spoilt)
    assert fits.rejected((0, 1), 2) == pytest.approx(share, rel=0.1)
    assert fits.rejected((0, 1), 3) < 0.01
    assert np.isnan(Fits(list(columns[:, :5])).rejected((0, 1, 2), 5))
