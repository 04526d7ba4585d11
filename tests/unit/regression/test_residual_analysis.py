"""What a balance says of the filter's values, what coarse steps leave of L, and which rows are spoilt: closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.signal import lfilter

from servo_daemon.regression.balances import Sums
from servo_daemon.regression.plausible import Plausible
from servo_daemon.regression.residual_analysis import Residuals, mean_error, structure, unexplained_var
from servo_daemon.regression.rls_fit import SYSTEMATIC
from servo_daemon.samples import F64
from servo_daemon.tracking.noise.levels import ProcessNoise
from servo_daemon.tracking.noise.quantised_input import QuantisedInput, along

N = 2000
TRUE = np.array([2.0, -0.5])
NOISELESS = np.zeros(2)


def rows(seed: int, noise: float = 0.0) -> tuple[F64, F64]:
    rng = np.random.default_rng(seed)
    Phi = rng.normal(size=(N, 2))
    return Phi, Phi @ TRUE + noise * rng.normal(size=N)


def sums(Phi: F64, y: F64) -> Sums:
    return Sums.of(Phi, y, np.ones(3))


def test_right_values_have_no_error() -> None:
    found = mean_error([Residuals.of(sums(*rows(1)), TRUE, NOISELESS)])
    assert found is not None
    np.testing.assert_allclose(found.error, 0.0, atol=1e-9)
    # Without noise the share SYSTEMATIC of y is left, along each of two regressors of variance 1.
    share = SYSTEMATIC * np.sqrt(N * np.sum(TRUE**2))
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), share / np.sqrt(N), rtol=0.1)


def test_wrong_values_are_found_wrong_by_what_they_are() -> None:
    found = mean_error([Residuals.of(sums(*rows(1)), TRUE * [1.2, 1.0], NOISELESS)])
    assert found is not None
    np.testing.assert_allclose(found.error, [-0.4, 0.0], atol=1e-9)


def test_values_that_follow_what_ages_have_no_error() -> None:
    """Each part beside the values of its time; one fit over both parts would find neither."""
    Phi, y = rows(1)
    older, newer = sums(Phi, y), sums(Phi, Phi @ (1.3 * TRUE))
    parts = [Residuals.of(older, TRUE, NOISELESS), Residuals.of(newer, 1.3 * TRUE, NOISELESS)]
    found = mean_error(parts)
    assert found is not None
    np.testing.assert_allclose(found.error, 0.0, atol=1e-9)
    assert structure(older.gram + newer.gram, 0.0) > 0.01 * (older.gram + newer.gram)[-1, -1]


def test_noise_of_the_regressors_is_no_error_of_the_values() -> None:
    """Seen with noise of variance 0.2 the regressors draw a fit to TRUE / 1.2."""
    Phi, y = rows(1)
    seen = Phi + np.sqrt(0.2) * np.random.default_rng(2).normal(size=Phi.shape)
    blind = mean_error([Residuals.of(sums(seen, y), TRUE, NOISELESS)])
    aware = mean_error([Residuals.of(sums(seen, y), TRUE, np.full(2, 0.2 * N))])
    assert blind is not None and aware is not None
    np.testing.assert_allclose(blind.error, -TRUE / 6, atol=0.1)
    assert (np.abs(aware.error) < 3 * np.sqrt(np.diag(aware.covariance))).all()


def test_nothing_is_said_of_what_the_rows_do_not_determine() -> None:
    Phi = np.outer(np.arange(N, dtype=float), [1.0, 2.0])
    assert mean_error([Residuals.of(sums(Phi, Phi @ TRUE), TRUE, NOISELESS)]) is None
    assert mean_error([]) is None


@pytest.mark.parametrize(("error", "std", "added"), [(0.015, 0.0, 0.0), (0.06, 0.03, 0.0), (0.2, 0.01, 0.198)])
def test_a_difference_is_doubt_only_beyond_chance(error: float, std: float, added: float) -> None:
    """Two standard deviations, of the difference and of 1 % that integrals over samples may be off, are chance."""
    assert unexplained_var(error, std**2) ** 0.5 == pytest.approx(added, abs=0.001)


# -- a voltage in coarse steps -----------------------------------------------------------------------------------------


def quantised(lsb: float, change_rms: float, R: float, L: float, period_s: float = 1e-3) -> float:
    found, rng = QuantisedInput(), np.random.default_rng(5)
    found.lsb_V = lsb
    value = {"R": R, "L": L}
    for _ in range(500):
        found.take(rng.normal(size=100) * change_rms / math.sqrt(2.0), period_s, value)
    return found.inductance_std(period_s, value)


def test_steps_leave_of_L_what_rounding_is_of_the_changes() -> None:
    """A winding that is slow against the sampling: the share itself; a fast one: (exp x − 1)/x times as much, for the
    smaller L that makes this one seen."""
    share = 0.1**2 / 6 / 0.2**2

    def lost(x: float) -> float:
        return share * math.expm1(x) / x

    assert quantised(0.1, 0.2, 1.0, 0.01) == pytest.approx(lost(0.1), rel=0.1)
    assert quantised(0.1, 0.2, 1.0, 5e-4) == pytest.approx(lost(2.0 * math.exp(lost(2.0))), rel=0.15)
    assert quantised(0.1, 0.01, 1.0, 0.01) == pytest.approx(math.expm1(0.3) / 0.3, rel=0.1), "all of it is rounding"
    assert quantised(0.0, 0.2, 1.0, 5e-4) == 0.0, "no steps"


def test_changes_within_the_time_of_a_winding_that_was_none_are_forgotten() -> None:
    """A filter that has just started may have L 25 times too large; a ramp changes more within so many samples."""
    found, ramp = QuantisedInput(), np.arange(100) * 0.1 + np.random.default_rng(5).normal(size=100) * 0.05
    found.lsb_V = 0.1
    right, wrong = {"R": 1.0, "L": 0.5e-3}, {"R": 1.0, "L": 12e-3}
    for _ in range(3):
        found.take(ramp, 1e-3, wrong)
    assert found.inductance_std(1e-3, wrong) < 0.002
    found.take(ramp, 1e-3, right)
    after_one = found.inductance_std(1e-3, right)
    for _ in range(100):
        found.take(ramp, 1e-3, right)
    assert after_one == pytest.approx(found.inductance_std(1e-3, right), rel=1e-6)
    assert after_one > 0.2


@pytest.mark.parametrize(("sensor_A", "hidden_V"), [(0.001, 0.0), (0.05, 0.0), (0.01, 0.05)])
@pytest.mark.parametrize("L", [0.02, 0.005, 0.0015, 0.0005])
@pytest.mark.parametrize(("memory", "size_V"), [(0.0, 0.2), (0.9, 0.18), (0.98, 1.0)])
def test_no_filter_of_the_current_is_off_by_more_than_what_steps_leave_of_L(
    memory: float, size_V: float, L: float, sensor_A: float, hidden_V: float
) -> None:
    """A winding is simulated, its voltage (white to slow, with a noise that is not recorded) recorded in steps, and L
    is where the mean of derivative times innovation of a steady Kalman filter vanishes."""
    R, h, lsb, n = 1.0, 1e-3, 0.1, 100_000
    rng = np.random.default_rng(7)
    w = lfilter([math.sqrt(1.0 - memory**2)], [1.0, -memory], rng.normal(size=n) * size_V)
    current = lfilter(
        [0.0, -math.expm1(-h * R / L) / R], [1.0, -math.exp(-h * R / L)], w + hidden_V * rng.normal(size=n)
    )
    y, u = current + sensor_A * rng.normal(size=n), lsb * np.round(w / lsb)
    x, P, noise_V2 = h * R / L, sensor_A**2, hidden_V**2 + lsb**2 / 12
    for _ in range(1000):
        P = math.exp(-2 * x) * P * sensor_A**2 / (P + sensor_A**2) + (math.expm1(-x) / R) ** 2 * noise_V2
    kappa = P / (P + sensor_A**2)

    def innovations(log_L: float) -> F64:
        a = math.exp(-h * R / math.exp(log_L))
        predicted = lfilter([0.0, a * kappa], [1.0, -a * (1 - kappa)], y)
        return np.asarray(y - predicted - lfilter([0.0, (1 - a) / R], [1.0, -a * (1 - kappa)], u))

    def score(off: float) -> float:
        log_L = math.log(L) + off
        return float((innovations(log_L - 1e-4) - innovations(log_L + 1e-4)) @ innovations(log_L))

    found = QuantisedInput()
    found.lsb_V = lsb
    for k in range(0, 10_000, 100):
        found.take(u[k : k + 100], h, {"R": R, "L": L})
    said = found.inductance_std(h, {"R": R, "L": L})
    assert abs(brentq(score, -0.5, 0.5)) < 1.1 * said + 1e-3
    assert said < 0.2 or L < 1e-3


def test_what_goes_with_L_is_off_with_it() -> None:
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(along(covariance, 0, 0.2), [0.2, 0.05, 0.0])


# -- spoilt rows, too much noise --------------------------------------------------------------------------------------


def test_a_few_rows_far_off_are_left_out_and_many_are_not() -> None:
    rng = np.random.default_rng(6)
    plausible, y = Plausible(), np.ones(50)
    residual = 1e-3 * rng.normal(size=50)
    assert plausible.rows(residual, y).all()
    residual[7] = 5.0
    assert np.flatnonzero(~plausible.rows(residual, y)).tolist() == [7]
    for _ in range(4):  # now it is the model
        kept = plausible.rows(np.where(np.arange(50) % 4 == 0, 5.0, residual), y)
    assert kept.all()


def test_noise_that_makes_another_channel_too_quiet_recedes() -> None:
    large = ProcessNoise(1e4)
    assert large.after(0.5, 2.0).factor > 1e4
    assert large.after(0.5, 2.0, too_much=True).factor < 1e4
    assert ProcessNoise(1.0).after(0.5, 2.0, too_much=True).factor == 1.0
