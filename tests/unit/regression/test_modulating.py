"""Modulated integrals against integrals known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.integrate import quad

from servo_daemon.regression.modulating import _phi_and_derivatives, _phi_integral, make_windows


def phi(s: float) -> float:
    return 1024.0 * s**5 * (1 - s) ** 5


@pytest.fixture
def jittered_time_s() -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.cumsum(1e-3 + rng.uniform(-3e-4, 3e-4, 400)) + 7.0


def test_integration_by_parts_moves_derivatives_to_the_window(jittered_time_s: np.ndarray) -> None:
    t = jittered_time_s
    w = make_windows(t, np.array([0, 50, 150]), 200)
    signal, rate, curvature = np.sin(20 * t), 20 * np.cos(20 * t), -400 * np.sin(20 * t)
    np.testing.assert_allclose(-w.integral(signal, 1), w.integral(rate), rtol=2e-4)
    np.testing.assert_allclose(w.integral(signal, 2), w.integral(curvature), rtol=2e-3)


def test_continuous_signal_is_integrated_as_quadrature_does(jittered_time_s: np.ndarray) -> None:
    t = jittered_time_s
    w = make_windows(t, np.array([10]), 300)
    a, b = t[10], t[309]
    expected, _ = quad(lambda x: phi((x - a) / (b - a)) * np.exp(3 * (x - 7)), a, b, epsabs=1e-12)
    assert w.integral(np.exp(3 * (t - 7)))[0] == pytest.approx(expected, rel=1e-5)


def test_held_signal_is_integrated_exactly_whatever_the_jitter(jittered_time_s: np.ndarray) -> None:
    t = jittered_time_s
    v = np.random.default_rng(6).normal(size=len(t))
    w = make_windows(t, np.array([0]), 60)
    a, b = t[0], t[59]
    pieces = (v[k] * quad(lambda x: phi((x - a) / (b - a)), t[k], t[k + 1], epsabs=1e-15)[0] for k in range(59))
    assert w.held(v)[0] == pytest.approx(sum(pieces), rel=1e-10)


def test_an_offset_of_the_position_drops_out(jittered_time_s: np.ndarray) -> None:
    t = jittered_time_s
    w = make_windows(t, np.array([0, 100]), 250)
    position = np.sin(9 * t)
    np.testing.assert_allclose(w.integral(position + 5.0, 1), w.integral(position, 1), atol=5e-5)


def test_the_modulating_functions_closed_forms_are_the_polynomials() -> None:
    s = np.linspace(0.0, 1.0, 101)
    phi = 1024.0 * Polynomial([0.0, 1.0, -1.0]) ** 5
    out = np.empty((3, len(s)))
    _phi_and_derivatives(s.copy(), out)
    for ours, theirs in zip(out, (phi, phi.deriv(), phi.deriv(2)), strict=True):
        np.testing.assert_allclose(ours, theirs(s), atol=1e-10)
    np.testing.assert_allclose(_phi_integral(s), phi.integ()(s), atol=1e-12)


@pytest.mark.parametrize("first", [[0, 40, 80, 120], [3, 40, 90], [17]])
def test_windows_say_the_same_whatever_lies_between_them_and_however_the_signal_is_stored(
    first: list[int], jittered_time_s: np.ndarray
) -> None:
    t = jittered_time_s
    together, signal = make_windows(t, np.array(first), 60), np.random.default_rng(7).normal(size=len(t))
    alone = [make_windows(t, np.array([k]), 60) for k in first]
    every_second = np.repeat(signal, 2)[::2]
    for x in (signal, every_second):
        assert np.array_equal(together.integral(x, 1), np.concatenate([w.integral(x, 1) for w in alone]))
        assert np.array_equal(together.held(x), np.concatenate([w.held(x) for w in alone]))
    some = np.arange(len(first)) != 1
    assert np.array_equal(together.only(some).held(signal), together.held(signal)[some])


@pytest.mark.parametrize("k", [-4, 0, 4])
def test_moved_windows_look_at_other_samples_and_hold_the_ends(k: int, jittered_time_s: np.ndarray) -> None:
    t, signal = jittered_time_s, np.random.default_rng(8).normal(size=400)
    w = make_windows(t, np.arange(0, 400 - 50 + 1, 50), 50)
    moved = signal[np.clip(np.arange(400) + k, 0, 399)]
    for derivative in range(3):
        assert np.array_equal(w.moved(k).integral(signal, derivative), w.integral(moved, derivative))
    assert np.array_equal(w.moved(k).held(signal), w.held(moved))
