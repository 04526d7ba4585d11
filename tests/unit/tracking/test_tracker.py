"""The two kinds of tracker: of a drive whose channels let a model run, and of one that only tells the time."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.kalman.gaussian import Gaussian, coordinates_of
from servo_daemon.plant.build import build_plant
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.tracking.plan.settings import Resolutions, TrackerSettings
from servo_daemon.tracking.plant_tracker import PlantTracker, make_tracker
from servo_daemon.tracking.tracker import Tracker


def block(**channels: float) -> SampleBlock:
    time_s = np.arange(20) * 1e-3 + 5.0
    return make_block(time_s, **{name: np.full(20, value) for name, value in channels.items()})  # type: ignore[arg-type]


def test_without_a_motion_there_is_time_and_what_was_measured_and_nothing_to_estimate() -> None:
    tracker = make_tracker(("current_A",), TrackerSettings(), Resolutions())
    assert type(tracker) is Tracker
    tracker.take(block(current_A=2.0))
    assert tracker.close_tick(block(current_A=2.0)) == []
    assert (tracker.first_s, tracker.last_s) == (5.0, 5.019)
    assert abs((tracker.sample_period_s or 0.0) - 1e-3) < 1e-9
    assert tracker.measured_state == {"current_A": 2.0, "velocity_rad_s": None, "position_rad": None}
    assert tracker.settled and tracker.explained and not tracker.examines_jump
    assert tracker.published() is tracker.worth_keeping() is tracker.last_known("R") is tracker.ekf is None


def test_with_voltage_current_and_angle_there_are_estimators() -> None:
    tracker = make_tracker(("voltage_V", "current_A", "position_rad"), TrackerSettings(), Resolutions())
    assert isinstance(tracker, PlantTracker)
    samples = block(voltage_V=1.0, current_A=2.0, position_rad=0.0)
    tracker.take(samples)
    assert tracker.close_tick(samples) == []
    assert not tracker.settled and not tracker.ekf.started and tracker.published() is None
    assert {"R", "L", "K", "J", "B"} <= {p.name for p in tracker.free} and tracker.ages_s


@pytest.mark.parametrize(("period_s", "parts"), [(0.02, 4), (0.004, 1)])
def test_friction_that_turns_round_between_slow_samples_is_filtered_in_parts(
    monkeypatch: pytest.MonkeyPatch, period_s: float, parts: int
) -> None:
    monkeypatch.setenv("SERVO_DAEMON_CC", "")  # a few samples: no need to compile
    plant = build_plant(("coulomb_friction",))
    saved = {"R": 1.13, "L": 0.33e-3, "K": 60.3e-3, "J": 4.0e-5, "B": 3.0e-5, "Tc": 0.018}
    known = Gaussian(plant.parameter_names, coordinates_of(plant.parameters, saved), 1e-4 * np.eye(len(saved)))
    settings = TrackerSettings(effects=("coulomb_friction",))
    tracker = make_tracker(("voltage_V", "current_A", "position_rad"), settings, Resolutions(), known)
    assert isinstance(tracker, PlantTracker)
    time_s, per_tick = np.arange(0.0, 1.0, period_s), round(0.1 / period_s)
    speed = 20.0 * np.sin(5.0 * time_s)
    current = np.sign(speed) * 0.3
    voltage = 1.13 * current + 60.3e-3 * speed
    whole = make_block(time_s, voltage_V=voltage, current_A=current, position_rad=np.cumsum(speed) * period_s)
    for first in range(0, len(time_s), per_tick):
        tick = whole.slice(first, first + per_tick)
        tracker.take(tick)
        tracker.close_tick(tick)
    assert tracker.ekf.started
    assert tracker.ekf.plant.parts == parts
