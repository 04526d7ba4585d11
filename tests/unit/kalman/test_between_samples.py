"""A torque that changes between two samples: the filter takes its mean and what its change does to the angle."""

from __future__ import annotations

import math

import numpy as np

from servo_daemon.conditioning.layout import Layout
from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.filterpy_ekf import FilterpyLoop
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.kalman.records import NoiseLevels
from servo_daemon.plant.build import build_plant
from servo_daemon.samples import F64, SampleBlock, make_block

K, J, B = 0.05, 4e-4, 1.5e-3
#: rad/s: at 100 Hz nine degrees of one and thirty of the other lie between two samples.
TONES = (2.0 * math.pi * 2.5, 2.0 * math.pi * 8.0)
SIZE = 0.3


def swinging(period_s: float, seconds: float = 20.0) -> SampleBlock:
    """J dω/dt = K i − B ω with two sines of i, the settled motion."""
    t = np.arange(round(seconds / period_s)) * period_s
    current, theta = np.zeros(len(t)), np.zeros(len(t))
    for w in TONES:
        H = K / (1j * w * (1j * w * J + B))  # from current to angle
        theta += SIZE * (H * np.exp(1j * w * t)).real
        current += SIZE * np.cos(w * t)
    return make_block(t, current_A=current, position_rad=theta)


def estimated(block: SampleBlock, *, engine: str = "compiled", angle_var: float = 1e-10) -> F64:
    """J and B over the truth."""
    plant = build_plant((), "current")
    loop = FilterpyLoop(plant, ("position_rad",)) if engine == "filterpy" else None
    ekf = Ekf(plant, ("position_rad",), loop)
    start = Gaussian(plant.parameter_names, np.log([K, 1.2 * J, 0.8 * B]), np.diag([1e-12, 0.09, 0.09]))
    ekf.start(start)
    ekf.set_noise(NoiseLevels(1e-6, 1e-12, (angle_var,)))
    ekf.set_active(np.array([0.0, 1.0, 1.0]), np.zeros(3))
    ekf.update(Layout("current", ("position_rad",)).rows(block, 0.0))
    return np.asarray(np.exp(ekf.estimate().mean[1:]) / (J, B))


def test_a_current_that_swings_between_two_samples_gives_the_inertia() -> None:
    """With a current that ran on a line and an angle by its mean J would be 4 % off."""
    off = estimated(swinging(0.01)) - 1.0
    assert abs(off[0]) < 3e-3 and abs(off[1]) < 0.02


def test_both_engines_take_it_alike() -> None:
    block = swinging(0.01, 2.0)
    found = [estimated(block, engine=engine, angle_var=1e-6) for engine in ("filterpy", "compiled")]
    np.testing.assert_allclose(*found, rtol=1e-6)
