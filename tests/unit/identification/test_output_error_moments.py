"""Voltages and currents of other moments than their samples': a supply that is switched by hand between them before a
winding whose rotor is held, a sensor that shows the mean over a part of a row."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.identification.output_error.fit import fit_output_error
from servo_daemon.identification.output_error.fitted import OutputErrorFit
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.plant.linear import linear_step
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


@pytest.mark.parametrize("seed", [1, 2])
def test_steps_between_the_samples_are_in_what_is_known_of_the_inductance(seed: int) -> None:
    found = blocked(np.random.default_rng(seed).uniform(0.0, 1.0, 24)).parameters["L"]
    assert found.value is None or (found.std is not None and abs(found.value - L) < 3.0 * found.std)


def test_a_voltage_that_is_held_gives_it_as_well_as_its_noise_lets_it() -> None:
    found = blocked(np.zeros(24)).parameters["L"]
    assert found.value is not None and found.std is not None
    assert abs(found.value - L) < 3.0 * found.std < 0.05 * L


MOTOR = {"R": 0.76, "L": 1e-3, "K": 0.049, "J": 1.1e-4, "B": 1.5e-4}
TC, FINE, ROW = 8e-3, 5e-4, 40


def averaged(over: int, seed: int = 4) -> OutputErrorFit:
    """A motor with dry friction (without, a mean is the current of a motor with another R and J) on steps of voltage at
    50 Hz, each current the mean of so many half milliseconds."""
    rng = np.random.default_rng(seed)
    n = 500
    voltage = np.repeat(rng.uniform(-12.0, 12.0, n // 10), 10)
    Ad, Bd = linear_step(MOTOR, FINE)
    x, path = np.zeros(3), np.empty((n * ROW, 3))
    for k in range(n * ROW):
        path[k] = x
        x = Ad @ x + Bd @ [voltage[k // ROW], TC * np.sign(x[1])]
    current = np.convolve(path[:, 0], np.ones(over) / over)[: n * ROW : ROW]
    block = make_block(
        np.asarray(FINE * ROW * np.arange(n), np.float64),
        voltage_V=voltage,
        current_A=current + rng.normal(0.0, 1e-3, n),
        velocity_rad_s=path[::ROW, 1] + rng.normal(0.0, 0.3, n),
    )
    return fit_output_error([Recording("ina219.csv", block)], ("coulomb_friction",))


@pytest.mark.parametrize("over", [17, 34])
def test_a_mean_over_a_part_of_a_row_is_told_and_in_what_is_known(over: int) -> None:
    fit = averaged(over)
    assert fit.current_late_s is not None and 0.5 < fit.current_late_s / (over * FINE / 2) < 1.5
    for name in ("R", "K", "J"):
        found = fit.parameters[name]
        assert found.value is None or (found.std is not None and abs(found.value - MOTOR[name]) < 3.0 * found.std)


def test_a_current_of_its_sample_is_not_late() -> None:
    fit = averaged(1)
    assert fit.current_late_s is None
    found = fit.parameters["R"]
    assert (
        found.value == pytest.approx(MOTOR["R"], rel=0.02) and found.std is not None and found.std < 0.02 * MOTOR["R"]
    )
