"""`long`: 10⁸ steps of the compiled filter on a periodic run: does its covariance stay one?

A minute of an ideal motor's motion under a voltage that repeats every minute (the second minute, when the transient is
gone), with sensor noise, is fed again and again with time moving on. After each pass (60,000 steps) the covariance is
factored (Cholesky of the correlation matrix, as it is, nothing added to its diagonal). Twice: with parameters that may
drift, and with constant ones, whose covariance shrinks for ever.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.kalman.records import NoiseLevels
from servo_daemon.plant.build import build_plant
from servo_daemon.samples import F64
from tests.recovery.generator import PAPER, Motor, Plan, Scenario, Sensors, generate, stream
from tests.recovery.tracking.bound import CHANNELS, WALK_PER_SQRT_MIN, ideal_sensors, rows
from tests.recovery.tracking.follow import NAMES

PERIOD_S = 60.0
TONES = 24
DRIFT_VAR_PER_S = {"parameters drift": WALK_PER_SQRT_MIN**2 / 60, "constant parameters": np.zeros(5)}


def periodic(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Sines of whole numbers of periods a minute, 0.15 to 100 Hz, up to 60 % of the supply."""
    tones = np.unique(np.round(PERIOD_S * 0.15 * (100 / 0.15) ** (np.arange(TONES) / (TONES - 1)))) / PERIOD_S
    phases = rng.uniform(0.0, 2 * np.pi, len(tones))
    voltage = np.sin(2 * np.pi * np.outer(time_s, tones) + phases).sum(axis=1)
    return Plan("voltage", 0.6 * motor.supply_V * voltage / np.abs(voltage).max())


def a_minute(motor: Motor, drift_var_per_s: F64) -> tuple[F64, Ekf]:
    """Rows that can be repeated, and a filter that has started 10 % off."""
    sensors, variances = ideal_sensors(motor)
    still = Sensors(current_noise_A=sensors.current_noise_A)
    recording = generate(motor, Scenario(periodic, seconds=2 * PERIOD_S, sensors=still, seed=1))
    ekf = Ekf(build_plant(), CHANNELS)
    truth = np.log([getattr(motor, n) for n in NAMES])
    ekf.start(Gaussian(NAMES, truth + 0.1, np.eye(5) * 0.01))
    ekf.set_noise(NoiseLevels(variances[0], 0.0, variances[1:]))
    ekf.set_active(np.ones(5), drift_var_per_s)
    samples = rows(recording, ekf.layout)[len(recording.time_s) // 2 :].copy()
    samples[:, 7] += stream(1, "position noise").normal(size=len(samples)) * np.sqrt(variances[2])
    return samples, ekf


def eigenvalue_ratio(P: F64) -> float:
    """Smallest over largest eigenvalue of the correlation matrix.

    Raises:
        numpy.linalg.LinAlgError: it is not positive definite.
    """
    scale = np.sqrt(np.diag(P))
    correlation = P / np.outer(scale, scale)
    np.linalg.cholesky(correlation)
    values = np.linalg.eigvalsh(correlation)
    return float(values[0] / values[-1])


def long_run(job: tuple[str, float]) -> str:
    """So many steps of the paper's motor; the findings in words."""
    drift, steps = job
    samples, ekf = a_minute(PAPER, DRIFT_VAR_PER_S[drift])
    smallest, spent, taken = np.inf, 0.0, 0
    while taken < steps:
        began = time.perf_counter()
        ekf.update(samples)
        spent += time.perf_counter() - began
        taken += len(samples)
        samples[:, 0] += PERIOD_S
        ekf.take_information()
        try:
            smallest = min(smallest, eigenvalue_ratio(ekf.covariance))
        except np.linalg.LinAlgError:
            return f"{drift}: NOT positive definite after {taken} steps"
    found = ekf.estimate()
    error = found.mean - np.log([getattr(PAPER, n) for n in NAMES])
    ends = ", ".join(f"{n} {100 * e:.4f} ± {100 * s:.4f}" for n, e, s in zip(NAMES, error, found.std, strict=True))
    return (
        f"{drift}: {taken:.3g} steps, {1e6 * spent / taken:.2f} µs each; smallest eigenvalue of the correlation matrix "
        f"{smallest:.1e} of the largest\n  last errors and std in %: {ends}"
    )


def report_long(steps: float) -> None:
    """Prints the smallest ratio of eigenvalues, the time a step takes, and where the filter ended."""
    print("\nThe compiled filter, 8 states, on a minute that repeats; its covariance factored every 60,000 steps")
    with ProcessPoolExecutor(2) as pool:
        for text in pool.map(long_run, [(drift, steps) for drift in DRIFT_VAR_PER_S]):
            print(text, flush=True)
