"""What no row of the winding's balance can show, in its standard deviations."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.regression.winding.estimate import WindingEstimate, as_meant, estimate_winding
from servo_daemon.regression.winding.rows import winding_rows
from servo_daemon.samples import make_block
from servo_daemon.signal_meaning import SignalMeaning

FOUND = WindingEstimate(
    ("R", "L", "K", "v0"), np.array([2.0, 1e-3, 0.05, 0.1]), np.diag([1e-4, 1e-10, 1e-10, 1e-6]), 0.0, 0.01
)


def test_a_factor_of_the_whole_voltage_is_one_of_r_l_and_k() -> None:
    meant = as_meant(FOUND, SignalMeaning("mean", voltage_scale_std=0.01), 1e-3)
    assert meant.of("K") == pytest.approx((0.05, np.hypot(1e-5, 5e-4)))
    assert meant.of("R") == pytest.approx((2.0, np.hypot(1e-2, 2e-2)))
    assert meant.covariance[0, 2] == pytest.approx(1e-4 * 2.0 * 0.05), "one factor of both"
    assert meant.of("v0") == FOUND.of("v0"), "an offset is not scaled by what is measured beside it"


def test_between_instants_there_is_no_inductance() -> None:
    assert as_meant(FOUND, SignalMeaning("instant"), 1e-3).names == ("R", "K", "v0")
    assert "L" in as_meant(FOUND, SignalMeaning("instant"), 1e-5).names


R, K, J, B = 0.5, 0.1, 1e-3, 5e-3
#: Sines of the speed, rad/s and rad/s.
SINES = ((60.0, 3.0), (25.0, 13.0), (12.0, 30.0))
#: Of a current controller: what of a change of the command is in the voltage at once, Ω.
GAIN = 2.0 * R


def signals(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angle, speed, current."""
    angle = sum(-a / w * np.cos(w * t) for a, w in SINES)
    speed = sum(a * np.sin(w * t) for a, w in SINES)
    return angle, speed, sum(a * (J * w * np.cos(w * t) + B * np.sin(w * t)) for a, w in SINES) / K


def told(ahead_s: float, period_s: float, meaning: SignalMeaning) -> WindingEstimate:
    """Of a drive whose voltage is of a later moment than the rest, with a command that changes at every sample."""
    t = np.arange(0.0, 10.0, period_s)
    noise = np.random.default_rng(1).normal(0.0, 1.0, (3, len(t)))
    angle, _, current = signals(t)
    _, speed, then = signals(t + ahead_s)
    step = signals(t + period_s)[2] - current if not ahead_s else 0.0
    voltage = R * then + K * speed + GAIN * step
    block = make_block(
        t,
        voltage_V=voltage + 1e-3 * noise[0],
        current_A=current + 1e-3 * noise[1],
        position_rad=angle + 1e-5 * noise[2],
    )
    rows = winding_rows(block, meaning)
    assert rows is not None
    found = estimate_winding([rows])
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("ahead_s", "meaning"),
    [(0.0, SignalMeaning("instant")), (5e-4, SignalMeaning("instant", control_period_s=1e-3))],
    ids=["commanded in step with its samples", "a voltage held for a millisecond"],
)
def test_a_voltage_of_another_moment_is_in_the_deviation_of_r(ahead_s: float, meaning: SignalMeaning) -> None:
    found = told(ahead_s, 5e-3, meaning)
    for name, truth in (("R", R), ("K", K)):
        pair = found.of(name)
        assert pair is not None
        value, std = pair
        assert abs(value - truth) < 1.96 * std < 0.1 * truth, (name, value / truth - 1.0, std / truth)
    R_pair = found.of("R")
    assert R_pair is not None and abs(R_pair[0] / R - 1.0) > 5e-3, "there is something to hold"
