"""What is noise and nothing else: tick by tick as at once."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.regression.held_shaft import NoiseAlone
from servo_daemon.samples import F64

RNG = np.random.default_rng(11)
CAUSE = np.repeat(RNG.normal(size=50), 40)
FLICKER = np.round(RNG.normal(0.0, 0.4, 2000)) * 1e-3


def told(values: F64, ticks: int = 1, *, about_zero: bool = False) -> bool:
    noise = NoiseAlone()
    for part, cause in zip(np.array_split(values, ticks), np.array_split(CAUSE[: len(values)], ticks), strict=True):
        noise.take(part, (cause,))
    return noise.holds(about_zero=about_zero)


@pytest.mark.parametrize("ticks", [1, 20, 2000])
def test_a_flicker_is_noise_however_it_is_cut(ticks: int) -> None:
    assert told(FLICKER, ticks)
    assert told(FLICKER, ticks, about_zero=True)


@pytest.mark.parametrize("ticks", [1, 20])
def test_what_moves_is_not(ticks: int) -> None:
    assert not told(FLICKER + np.linspace(0.0, 0.01, 2000), ticks)
    assert not told(FLICKER + 5e-5 * CAUSE, ticks)
    assert not told(FLICKER + np.append(0.0, 5e-5 * CAUSE[:-1]), ticks)


def test_a_mean_speed_is_a_motion() -> None:
    assert told(FLICKER + 5e-4)
    assert not told(FLICKER + 5e-4, about_zero=True)


def test_a_few_samples_do_not_tell() -> None:
    assert not told(FLICKER[:50])
