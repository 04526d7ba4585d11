"""Starts and changes that one pass of the filter does not find: what makes it begin again from the regressions, and
what makes it go back over its first samples when a guess jumps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.samples import F64
from tests.recovery.generator import PAPER, Motor, Plan, Recording, Scenario, generate
from tests.recovery.tracking.follow import Track, tracked

pytestmark = pytest.mark.usefixtures("generator_built")
RATE_HZ, CORE = 200.0, ("R", "K", "J", "B")


def moved(seconds: float, seed: int) -> F64:
    """A multisine's voltages."""
    return generate(PAPER, Scenario("multisine", seconds=seconds, rate_hz=RATE_HZ, seed=seed)).voltage_V


def recorded(motor: Motor, voltage_V: F64, seed: int) -> Recording:
    scenario = Scenario(Plan("voltage", voltage_V), len(voltage_V) / RATE_HZ, RATE_HZ, seed=seed)
    return generate(motor, scenario)


def nominal(**factors: float) -> Mapping[str, float]:
    """A datasheet of the motor that is wrong by these."""
    return {n: factors.get(n, 1.0) * getattr(PAPER, n) for n in ("R", "L", "K", "J", "B")}


def assert_known(track: Track, motor: Motor) -> None:
    """All of R, K, J and B are tracked at the end, within 3 of their std and 3 %."""
    for name in CORE:
        k = track.names.index(name)
        error = abs(track.value[-1, k] / getattr(motor, name) - 1.0)
        assert track.tracking[-1, k], (name, track.status[-1, k])
        assert error < max(0.03, 3.0 * track.std[-1, k] / getattr(motor, name)), (name, error)


def test_after_a_constant_speed_a_datasheet_five_times_off_is_overcome() -> None:
    """The filter starts while the motion says nothing of the shaft. Fails without going back over the first samples
    whenever a guess has jumped: the filter diverges, and begins again from less."""
    constant = np.full(round(5.0 * RATE_HZ), 0.05 * PAPER.supply_V)
    made = recorded(PAPER, np.concatenate([constant, moved(10.0, seed=4)]), seed=5)
    track = tracked(made, nominal(R=0.2, K=5.0, J=0.2))
    assert [told.kind for told in track.told] == ["filter_started"]
    assert_known(track, PAPER)


def exchanged(before: F64, motor: Motor, seed: int) -> Recording:
    """The motor with these voltages, half a second of rest, then 8 s of a multisine of another one."""
    first = recorded(PAPER, np.concatenate([before, np.zeros(round(0.5 * RATE_HZ))]), seed)
    then = recorded(motor, moved(8.0, seed), seed + 1)
    position = np.concatenate([first.position_rad, first.position_rad[-1] + then.position_rad - then.position_rad[0]])
    return replace(
        first,
        time_s=np.arange(len(position)) / RATE_HZ,
        voltage_V=np.concatenate([first.voltage_V, then.voltage_V]),
        current_A=np.concatenate([first.current_A, then.current_A]),
        position_rad=position,
    )


@pytest.fixture(scope="module")
def other() -> Motor:
    """Another winding and three times the inertia: no step of one parameter."""
    return replace(PAPER, R=2.5 * PAPER.R, J=3.0 * PAPER.J)


def test_a_filter_that_no_longer_fits_begins_again_where_the_regression_does(other: Motor) -> None:
    """Fails without the divergence restart: J and K are not known for the rest of it."""
    track = tracked(exchanged(moved(8.0, seed=4), other, seed=5), nominal())
    assert "filter_restarted" in [told.kind for told in track.told]
    assert_known(track, other)


def test_a_filter_that_started_from_little_claims_nothing_wrong_of_another_motor(other: Motor) -> None:
    """3 s of a motor with a wrong datasheet, then another motor."""
    track = tracked(exchanged(moved(3.0, seed=4), other, seed=5), nominal(R=0.3, K=3.0, J=0.3))
    for name in CORE:
        k = track.names.index(name)
        error = abs(track.value[-1, k] - getattr(other, name))
        if track.tracking[-1, k]:
            assert error < max(0.03 * getattr(other, name), 4.0 * track.std[-1, k]), (name, error)
