"""What stops a motor, sample by sample."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servo_daemon.commissioning import MotionLimits
from servo_daemon.commissioning.stop import StoppedError
from servo_daemon.commissioning.supervisor import Reading, Supervisor


def test_noise_on_a_late_line_is_no_rise_and_a_rise_is_one() -> None:
    """A host that was busy while nothing moved: commands act 0.3 s late at first."""
    s = Supervisor(MotionLimits(24.0, 20.0, 20.0, 6.0, 60.0), 1e-3, 2 * math.pi / 8192, 0.05)
    noise = iter(0.06 * np.random.default_rng(1).standard_normal(2000))
    times = iter(1e-3 * np.arange(2000))

    def sample(current_A: float = 0.0) -> None:
        s.check(Reading(next(times), 0.0, current_A + next(noise), 0.0), 0.0)

    for _ in range(300):
        sample()
    s.resting, s.latency_s = False, 0.3
    for _ in range(300):
        sample()
    s.driven, s.latency_s = True, 0.03
    for _ in range(1000):
        sample()
    sample(0.5)
    with pytest.raises(StoppedError, match=r"current is about to pass .* \(commands act 30 ms late\)"):
        sample(1.5)
