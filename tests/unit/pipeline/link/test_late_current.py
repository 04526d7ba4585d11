"""A current that is late against the angle: the filter's motion is of its moment, and B says how far it is open."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.link.current_timing import CurrentTiming
from servo_daemon.pipeline.link.measured_link import MeasuredLink
from servo_daemon.published.snapshot import Covariance, Estimate, ParameterEstimate
from servo_daemon.samples import F64, SampleBlock, concatenate, make_block
from servo_daemon.signal_meaning import SignalMeaning

LATE = SignalMeaning("instant", "instant", "dq", current_late_s=4e-4)
#: A wheel: it slows down by itself in 1.75 s.
J, B = 0.035, 0.02
T = np.arange(0.0, 30.0, 1e-3)
OMEGA = 20.0


def position(t: F64) -> F64:
    return np.asarray(np.sin(OMEGA * t))


def block(t: F64 = T) -> SampleBlock:
    speed = OMEGA * np.cos(OMEGA * t)
    return make_block(t, voltage_V=speed, current_A=speed, position_rad=position(t), velocity_rad_s=speed)


@pytest.mark.parametrize("cuts", [[], [1, 2, 700, 701]])
def test_the_filters_motion_is_of_the_currents_moment(cuts: list[int]) -> None:
    link, whole = MeasuredLink(DriveConfig(), LATE), block(T[:1000])
    parts = [whole.slice(a, b) for a, b in zip([0, *cuts], [*cuts, 1000], strict=True)]
    driven = concatenate([link.driven(p) for p in parts])
    assert driven.voltage_V is None and driven.position_rad is not None and driven.velocity_rad_s is not None
    before = T[1:1000] - LATE.current_late_s
    np.testing.assert_allclose(driven.position_rad[1:], position(before), atol=1e-4)
    np.testing.assert_allclose(driven.velocity_rad_s[1:], OMEGA * np.cos(OMEGA * before), atol=2e-3)
    assert driven.position_rad[0] == 0.0  # the first of all, wherever the first block ends


def fitted_B(late_s: float) -> float:
    """Of the balance of torques, whose torque is so late."""
    speed, acceleration = OMEGA * np.cos(OMEGA * T), -(OMEGA**2) * np.sin(OMEGA * T)
    then = T - late_s
    torque = -J * OMEGA**2 * np.sin(OMEGA * then) + B * OMEGA * np.cos(OMEGA * then)
    return float(np.linalg.lstsq(np.column_stack([acceleration, speed]), torque, rcond=None)[0][1])


@pytest.mark.parametrize("channel", ["position_rad", "velocity_rad_s"])
def test_b_is_open_by_what_a_control_period_moves_it(channel: str) -> None:
    timing, whole = CurrentTiming(SignalMeaning("instant"), torques=False), block()
    for at in range(0, len(T), 100):
        tick = whole.slice(at, at + 100)
        timing.take(make_block(tick.time_s, **{channel: getattr(tick, channel)}))
    known = (
        ParameterEstimate("J", J, 1e-5, "", None, "tracking"),
        ParameterEstimate("B", B, 3e-4, "", None, "tracking"),
    )
    covariance = Covariance(("J", "B"), ((1e-6, 0.0), (0.0, (3e-4 / B) ** 2)))
    found = timing.widened(Estimate(30.0, len(T), 1e3, (), known, {}, {}, {}, covariance))
    moved = fitted_B(5e-5) - B
    assert moved > 0.02 * B
    std = found.parameters[1].std
    assert std == pytest.approx(np.hypot(moved, 3e-4), rel=0.05)
    assert found.parameters[0] == known[0] and found.covariance is not None
    assert np.sqrt(found.covariance.values[1][1]) == pytest.approx(std / B)


def test_a_torque_alone_leaves_every_torque_open_by_its_moment() -> None:
    """0.3 % and half a period of a second: what links with a voltage add, and `moteus` by torque lacked."""
    timing = CurrentTiming(SignalMeaning("instant"), torques=True)
    t = np.arange(0.0, 0.1, 0.01)
    timing.take(make_block(t, torque_Nm=np.zeros(len(t)), position_rad=np.zeros(len(t))))
    known = (
        ParameterEstimate("J", J, 1e-5 * J, "", None, "tracking"),
        ParameterEstimate("B", B, 0.01 * B, "", None, "tracking"),
        ParameterEstimate("R", 1.0, 1e-3, "", None, "fixed"),
    )
    covariance = Covariance(("J", "B"), ((1e-10, 0.0), (0.0, 1e-4)))
    found = timing.widened(Estimate(30.0, len(T), 1e3, (), known, {}, {}, {}, covariance))
    share = 3e-3 + 0.5 * 0.01
    assert [p.std / p.value for p in found.parameters if p.std and p.value] == pytest.approx(
        [share, np.hypot(share, 0.01), 1e-3], rel=1e-4
    )
    assert found.covariance is not None
    assert np.sqrt(np.diag(found.covariance.values)) == pytest.approx([share, np.hypot(share, 0.01)], rel=1e-4)
