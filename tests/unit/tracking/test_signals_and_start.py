"""What a set of signals determines, and where the filter starts."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.parameters import LINEAR
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.tracking.plan.signals import plan_signals
from servo_daemon.tracking.start.starting_point import starting_point, well_known

ALL = ("voltage_V", "current_A", "position_rad")
NOMINAL = {"R": 0.5, "L": 2e-3, "K": 0.3, "J": 0.01, "B": 0.5}
NAMES = ("R", "L", "K", "J", "B")


@pytest.mark.parametrize(
    ("channels", "nominal", "free"),
    [
        (ALL, {}, NAMES),
        (("voltage_V", "current_A", "velocity_rad_s"), {}, NAMES),
        (("voltage_V", "position_rad"), {}, ()),
        (("voltage_V", "position_rad"), NOMINAL, ("J", "B")),
        (("current_A", "position_rad"), {}, ()),
        (("current_A", "position_rad"), {"K": 0.3}, ("J", "B")),
        (("position_rad", "torque_Nm"), {}, ("J", "B")),
        (("voltage_V", "current_A"), NOMINAL, ()),
        (("position_rad",), NOMINAL, ()),
        ((), {}, ()),
    ],
)
def test_free_parameters(channels: tuple[str, ...], nominal: dict[str, float], free: tuple[str, ...]) -> None:
    plan = plan_signals(channels, (), nominal)
    assert plan.free == free
    for name in set(NAMES) - set(free):
        assert plan.reasons[name], f"no reason given for {name}"
    assert all(plan.held[name] == nominal[name] for name in plan.held)


def test_effects_come_along() -> None:
    assert "Tc" in plan_signals(("current_A", "position_rad"), ("coulomb_friction",), NOMINAL).free


def estimate(value: list[float], relative: float | list[float]) -> RegressionEstimate:
    v = np.array(value)
    return RegressionEstimate(NAMES, v, np.diag(np.square(np.abs(v) * relative)), span_s=2.5, closes=True)


def test_a_good_regression_starts_alone() -> None:
    found = estimate([0.5, 2e-3, 0.3, 0.01, 0.5], 0.01)
    assert well_known(found, NAMES)
    start = starting_point(LINEAR, found, {})
    assert start is not None
    np.testing.assert_allclose(np.exp(start.mean), found.value)
    assert (start.std > 0.03).all() and (start.std < 0.04).all()


def test_correlations_of_the_regression_are_kept() -> None:
    found = estimate([0.5, 2e-3, 0.3, 0.01, 0.5], 0.02)
    found.covariance[0, 2] = found.covariance[2, 0] = -0.9 * found.std[0] * found.std[2]
    start = starting_point(LINEAR, found, {})
    assert start is not None
    correlation = start.covariance[0, 2] / np.sqrt(start.covariance[0, 0] * start.covariance[2, 2])
    assert -0.9 < correlation < -0.8
    assert np.linalg.eigvalsh(start.covariance).min() > 0


def test_nominal_values_fill_what_is_not_seen() -> None:
    start = starting_point(LINEAR, None, NOMINAL)
    assert start is not None
    np.testing.assert_allclose(np.exp(start.mean), list(NOMINAL.values()))
    assert starting_point(LINEAR, None, {}) is None


def test_an_absurd_nominal_value_is_not_believed() -> None:
    """The regression cannot say what B is, but it can say that it is not 0.5."""
    found = estimate([0.5, 2e-3, 0.3, 0.01, 1e-5], [0.01, 0.01, 0.01, 0.01, 3.0])
    start = starting_point(LINEAR, found, NOMINAL)
    assert start is not None
    assert np.exp(start.mean[4]) < 1e-3 and start.std[4] > 1


def test_impossible_values_are_no_start() -> None:
    found = estimate([-0.5, 2e-3, 0.3, 0.01, 0.5], 0.01)
    assert not well_known(found, NAMES)
    start = starting_point(LINEAR, found, NOMINAL)
    assert start is not None and np.isfinite(start.mean).all()
