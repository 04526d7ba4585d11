"""Noise of a measured voltage that the motor never sees, and what it makes of L."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error import OutputErrorFit, Recording, fit_output_error
from servo_daemon.identification.output_error.precision.voltage_noise import roughness
from servo_daemon.samples import F64, make_block

R, PERIOD_S = 2.0, 1e-3


def held_rotor(voltage: F64, per_period: float, *, voltage_std: float, seed: int) -> OutputErrorFit:
    """The exact current of R and L under a held voltage, both measured with noise; L/R of so many periods."""
    random, decay = np.random.default_rng(seed), np.exp(-1.0 / per_period)
    current = np.zeros(len(voltage))
    for k, v in enumerate(voltage[:-1]):
        current[k + 1] = decay * current[k] + (1.0 - decay) * v / R
    block = make_block(
        PERIOD_S * np.arange(len(voltage)),
        voltage_V=voltage + voltage_std * random.standard_normal(len(voltage)),
        current_A=current + 0.005 * random.standard_normal(len(voltage)),
        position_rad=np.zeros(len(voltage)),
    )
    return fit_output_error([Recording("held rotor", block)])


def steps(seed: int) -> F64:
    return np.repeat(np.random.default_rng(seed).uniform(-6.0, 6.0, 20), 100)


@pytest.mark.parametrize("per_period", [0.12, 0.4])
def test_an_inductance_below_a_sample_claims_no_more_than_the_voltage_s_noise_leaves(per_period: float) -> None:
    off = []
    for seed in (1, 3):
        found = held_rotor(steps(seed), per_period, voltage_std=0.06, seed=seed).parameters
        assert found["R"].value == pytest.approx(R, rel=2e-3)
        L = found["L"]
        if L.std is not None and L.value is not None:
            off.append((L.value - per_period * R * PERIOD_S) / L.std)
    assert max(np.abs(off), default=0.0) < 3.0


def test_a_voltage_that_is_known_costs_l_nothing() -> None:
    """Nor does one that is rich: its noise is nothing beside it."""
    random = np.random.default_rng(3)
    for voltage, std, most in ((steps(3), 0.0, 0.02), (random.uniform(-6.0, 6.0, 2000), 0.03, 0.01)):
        L = held_rotor(voltage, 0.4, voltage_std=std, seed=4).parameters["L"]
        assert L.value is not None and L.std is not None
        assert L.std < most * L.value and abs(L.value - 0.4 * R * PERIOD_S) < 4.0 * L.std


def test_the_noise_of_a_signal_is_seen_beside_its_steps_and_its_motion() -> None:
    random, t = np.random.default_rng(5), np.linspace(0.0, 1.0, 4000)
    noise = 0.1 * random.standard_normal(len(t))
    for smooth in (np.zeros(len(t)), np.repeat(random.uniform(-6.0, 6.0, 80), 50), 6.0 * np.sin(20.0 * t)):
        assert roughness(smooth + noise) == pytest.approx(0.1, rel=0.15)
        assert roughness(smooth) < 1e-3
