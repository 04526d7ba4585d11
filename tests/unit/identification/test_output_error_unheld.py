"""A voltage that is switched between its samples, as a supply by hand before a winding whose rotor is held."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error.fit import fit_output_error
from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.samples import F64, make_block

R, L, H = 0.92, 0.71e-3, 2e-3


def blocked(share: F64, seed: int = 3) -> OutputErrorFit:
    """A winding on steps that come a share of a sampling interval before they are seen, shape (steps,)."""
    rng = np.random.default_rng(seed)
    voltage = np.repeat(np.where(np.arange(len(share)) % 2, 1.0, -1.0) * rng.uniform(1.0, 4.0, len(share)), 100)
    current, i = np.zeros(len(voltage)), 0.0
    for k in range(1, len(voltage)):
        early = share[k // 100] * H if k % 100 == 0 else 0.0
        for v, lasting in ((voltage[k - 1], H - early), (voltage[k], early)):
            i = v / R + (i - v / R) * np.exp(-R / L * lasting)
        current[k] = i
    block = make_block(
        np.asarray(H * np.arange(len(voltage)), np.float64),
        voltage_V=voltage,
        current_A=current + rng.normal(0.0, 0.01, len(voltage)),
        position_rad=np.zeros(len(voltage)),
    )
    return fit_output_error([Recording("stall.csv", block)])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_steps_between_the_samples_are_in_what_is_known_of_the_inductance(seed: int) -> None:
    found = blocked(np.random.default_rng(seed).uniform(0.0, 1.0, 24)).parameters["L"]
    assert found.value is None or (found.std is not None and abs(found.value - L) < 3.0 * found.std)


def test_a_voltage_that_is_held_gives_it_as_well_as_its_noise_lets_it() -> None:
    found = blocked(np.zeros(24)).parameters["L"]
    assert found.value is not None and found.std is not None
    assert abs(found.value - L) < 3.0 * found.std < 0.05 * L
