"""Noise levels separated from signals, and followed."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.numerics import white_noise_var
from servo_daemon.tracking.noise import levels as noise
from servo_daemon.tracking.noise.levels import ChannelNoise, ProcessNoise, Whiteness


def test_white_noise_is_found_under_a_smooth_signal() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(4000) * 1e-3
    signal = 5 * np.sin(40 * t) + 3 * np.sign(np.sin(3 * t))
    assert white_noise_var(signal + 0.02 * rng.normal(size=4000)) == pytest.approx(0.02**2, rel=0.15)


@pytest.mark.parametrize("lsb", [1e-3, 2 * np.pi / 4096])
def test_the_step_of_a_quantised_signal_is_found(lsb: float) -> None:
    t = np.arange(3000) * 1e-3
    assert noise.smallest_step(np.round(2 * np.sin(t) / lsb) * lsb) == pytest.approx(lsb, rel=1e-6)


def test_a_signal_without_steps_has_no_step() -> None:
    assert noise.smallest_step(np.random.default_rng(1).normal(size=2000)) == 0.0
    assert noise.smallest_step(np.zeros(100)) == 0.0


def test_a_quantised_channel_is_never_better_than_its_step() -> None:
    start = noise.initial_noise(np.repeat([0.0, 1e-3], 50), 1e-3)
    assert start.var >= 1e-6 / 12
    quiet = noise.adapted(start, -start.var, 100.0)
    assert quiet.var >= 1e-6 / 12


@pytest.mark.parametrize("true_std", [0.01, 0.3])
def test_adaptation_finds_the_level_from_innovations(true_std: float) -> None:
    rng = np.random.default_rng(2)
    level = ChannelNoise(0.05**2, 1e-12)
    for _ in range(600):
        squared = np.minimum((true_std * rng.normal(size=100)) ** 2, 16 * level.var)
        level = noise.adapted(level, float(np.mean(squared - level.var)), 0.1)
    assert level.var == pytest.approx(true_std**2, rel=0.2)


def test_process_noise_rises_on_drifting_innovations_and_falls_back() -> None:
    level = ProcessNoise()
    for _ in range(10):
        level = level.after(correlation=0.9, nis=50.0)
    assert level.factor > 50
    for _ in range(500):
        level = level.after(correlation=0.0, nis=1.0)
    assert level.factor == 1.0


def test_process_noise_ignores_a_slow_encoder() -> None:
    """At rest the encoder's error stands still: correlated, but far too small to be a drift."""
    assert ProcessNoise().after(correlation=0.99, nis=0.01).factor == 1.0


def correlation_and_nis(e: np.ndarray) -> tuple[float, float]:
    nis = float(np.mean(e * e))
    return float(np.sum(e[1:] * e[:-1])) / (len(e) * nis), nis


def test_whiteness_of_white_and_of_coloured_innovations() -> None:
    rng = np.random.default_rng(4)
    white, coloured = Whiteness(), Whiteness()
    for _ in range(300):
        white = white.after(*correlation_and_nis(rng.normal(size=100)), 0.1)
        coloured = coloured.after(*correlation_and_nis(np.convolve(rng.normal(size=101), [1, 1], "valid")), 0.1)
    assert abs(white.correlation) < 0.05 and white.nis == pytest.approx(1.0, abs=0.1)
    assert coloured.correlation == pytest.approx(0.5, abs=0.07)


def test_the_share_of_the_input_is_steered_to_white_innovations() -> None:
    """Sizes fit, but neighbours are alike: part of what is taken for sensor noise comes in through the voltage."""
    level = ProcessNoise()
    for _ in range(60):
        level = level.after(correlation=0.2, nis=1.0, follow=0.2)
    assert level.factor > 3
    held = ProcessNoise()
    for _ in range(60):
        held = held.after(correlation=0.2, nis=1.0)
    assert held.factor == 1.0
    for _ in range(2000):
        level = level.after(correlation=-0.2, nis=1.0, follow=-0.2)
    assert level.factor == 1.0
