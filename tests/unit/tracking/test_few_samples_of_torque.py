"""A hundred samples a second of a torque, of motion with rests: what happens between samples, and while a shaft creeps,
is no reason for a wrong value."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.base import DriveInfo
from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import SampleBlock, make_block

TRUE = {"J": 3e-4, "B": 1.1e-3, "Tc": 0.035}
RATE_HZ, EVERY, SECONDS = 2000, 20, 12.0
COUNT = 2 * np.pi / 16384


def there_and_back() -> SampleBlock:
    """Trapezoids of speed under a PI controller; the friction is a smooth step of 0.05 rad/s, so that the shaft creeps
    where it is to stand."""
    h, n = 1.0 / RATE_HZ, round(SECONDS * RATE_HZ)
    J, B, Tc = TRUE.values()
    gain = 150.0 * J
    out = np.empty((3, n))
    w = angle = held = 0.0
    for k in range(n):
        move, s = divmod(k * h, 0.9)
        want = 55.0 * (1.0, -0.7, 0.5, -0.8)[int(move) % 4] * max(0.0, min(s / 0.15, 1.0, (0.65 - s) / 0.15))
        torque = gain * (want - w) + held
        held += 40.0 * gain * (want - w) * h
        out[:, k] = torque, angle, w
        for _ in range(4):
            w += h / 4 * (torque - B * w - Tc * np.tanh(w / 0.05)) / J
            angle += h / 4 * w
    torque, angle, w = out[:, ::EVERY]
    t = EVERY * h * np.arange(len(w))
    return make_block(t, torque_Nm=torque, position_rad=COUNT * np.rint(angle / COUNT), velocity_rad_s=w)


def test_no_tick_has_a_wrong_value_and_all_are_known_at_the_end() -> None:
    block = there_and_back()
    info = DriveInfo("x", EVERY / RATE_HZ, channels=("torque_Nm", "position_rad", "velocity_rad_s"))
    pipeline = Pipeline(DriveConfig(model=["coulomb_friction"]), info)
    wrong = []
    for first in range(0, len(block), 10):
        pipeline.process(block.slice(first, first + 10), rows=False)
        estimate = pipeline.current()
        for p in estimate.parameters if estimate is not None else ():
            if p.status != "tracking" or p.name not in TRUE or p.value is None or p.std is None:
                continue
            if abs(p.value - TRUE[p.name]) > max(4.0 * p.std, 0.05 * TRUE[p.name]):
                wrong.append((first, p.name, p.value / TRUE[p.name], p.std / TRUE[p.name]))
    assert not wrong
    estimate = pipeline.finish() or pipeline.current()
    assert estimate is not None
    known = {p.name: p.value for p in estimate.parameters if p.status == "tracking"}
    assert known == pytest.approx(TRUE, rel=0.05)
    found = estimate.estimators["rls"].parameters
    assert {name: found[name][0] for name in TRUE} == pytest.approx(TRUE, rel=0.03)
