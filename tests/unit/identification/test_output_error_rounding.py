"""Stretches of a coarse reading that share one rounding error, and how large it may be."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error.precision.rounding import rounding_sizes, step_of

STEP = 0.01
ONE = STEP / np.sqrt(12.0)


def rounded(x: np.ndarray) -> np.ndarray:
    return np.round(x / STEP) * STEP * np.sqrt(1.5)  # as after the conversion of a dq current


def test_the_step_of_readings_is_found_and_a_continuous_signal_has_none() -> None:
    random = np.random.default_rng(0)
    x = random.normal(0.0, 0.2, 2000)
    assert step_of(rounded(x)) == pytest.approx(STEP * np.sqrt(1.5))
    assert step_of(x) == 0.0 and step_of(np.ones(100)) == 0.0
    cut = np.trunc(x / STEP) * STEP
    assert step_of(cut + 0.5 * STEP * np.sign(cut)) == pytest.approx(STEP)  # half a step put back but at zero


def test_every_stretch_that_reads_the_same_has_one_error() -> None:
    begins, size = rounding_sizes(rounded(np.repeat([0.047, -0.033, 0.02, 0.1], 100)))
    assert begins.tolist() == [0, 100, 200, 300]
    np.testing.assert_allclose(size, ONE * np.sqrt(1.5))


def test_a_reading_that_goes_to_and_fro_tells_its_mean_better() -> None:
    """The spread of the mean's true error over signals between two codes, with little noise, is no larger than said."""
    random = np.random.default_rng(1)
    off, said = [], []
    for level in random.uniform(0.05, 0.06, 200):
        true = np.r_[level + random.normal(0.0, 0.002, 400), np.linspace(0.1, 0.5, 100)]
        begins, size = rounding_sizes(rounded(true) / np.sqrt(1.5))
        share = np.diff(np.append(begins, 500))[begins < 400] / 400.0
        off.append(np.mean(rounded(true[:400]) / np.sqrt(1.5)) - level)
        said.append(np.sqrt(np.sum((share * size[begins < 400]) ** 2)))
    off, said = np.array(off), np.array(said)
    assert np.sqrt(np.mean(off**2)) < 1.1 * np.sqrt(np.mean(said**2)) < 1.1 * ONE
    assert np.mean(np.abs(off) < 1.96 * said) > 0.9


def test_noise_of_several_steps_needs_none_of_it() -> None:
    noisy = rounded(np.random.default_rng(2).normal(0.0, 5.0 * STEP, 1000))
    assert len(rounding_sizes(noisy)[0]) == 0
