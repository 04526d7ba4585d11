"""The generator in open loop behind ideal sensors: what its own tests run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.recovery.generator import Motor, Plan, Recording, Scenario, Sensors, generate

F64 = NDArray[np.float64]

#: A motor without back-EMF, resistance to speak of, or viscous friction: the mechanics alone.
INERT = Motor("inert", 1.0, 1e-3, 1e-12, 0.01, 1e-12, 1e-9, 1.0, 1.0, 0.0, "for the tests")


def run(motor: Motor, voltage: F64 | float, seconds: float, rate_hz: float = 1000.0, **more: Any) -> Recording:
    """Ideal sensors, open loop, a voltage of shape (n,) or a constant."""
    n = round(seconds * rate_hz)
    plan = Plan("voltage", np.full(n, voltage) if np.isscalar(voltage) else np.asarray(voltage))
    # limits that no test here reaches
    free = replace(motor, supply_V=5 * motor.supply_V, current_limit_A=20 * motor.current_limit_A)
    return generate(free, Scenario(plan, seconds, rate_hz, sensors=Sensors(), **more))


def broadband(motor: Motor, n: int) -> F64:
    """A rough voltage of 0.3 × supply, shape (n,)."""
    return 0.3 * motor.supply_V * np.random.default_rng(11).normal(size=n)


def states(recording: Recording) -> F64:
    """Current, speed, angle, shape (n, 3)."""
    truth = recording.truth
    return np.column_stack([truth.current_A, truth.speed_rad_s, truth.position_rad])


def worst(actual: F64, expected: F64) -> float:
    """The largest deviation of a column, relative to the column's largest value."""
    return float(np.max(np.abs(actual - expected).max(axis=0) / (np.abs(expected).max(axis=0) + 1e-300)))
