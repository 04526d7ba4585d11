"""The ring of recent samples: the last seconds, uninterrupted, bounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.samples import Quality, SampleBlock, concatenate, make_block
from servo_daemon.simulate import DEFAULT_NOMINAL, SimulatedDrive, make_settings


def tick(k: int, n: int = 100, period_s: float = 1e-3) -> SampleBlock:
    time_s = (k * n + np.arange(n)) * period_s
    return make_block(time_s, voltage_V=np.sin(time_s), current_A=np.cos(time_s), position_rad=time_s)


def times(ring: SampleRing) -> np.ndarray:
    return concatenate(ring.blocks()).time_s


def test_it_keeps_the_last_seconds_and_no_more() -> None:
    ring = SampleRing(2.0)
    assert ring.span_s == 0.0 and ring.blocks() == ()
    for k in range(57):
        ring.append(tick(k))
        assert ring.span_s <= 2.0
        assert ring.samples == len(times(ring))
    assert ring.samples == 2000
    assert times(ring)[[0, -1]] == pytest.approx([3.7, 5.699])


def test_it_never_holds_more_samples_than_it_may() -> None:
    ring = SampleRing(60.0, samples=1050)
    for k in range(30):
        ring.append(tick(k))
    assert ring.samples == 1000


def test_none_is_kept_where_none_is_wanted() -> None:
    ring = SampleRing(0.0)
    ring.append(tick(0))
    assert ring.samples == 0 and ring.blocks() == ()


def test_it_begins_anew_where_the_motion_before_is_unknown() -> None:
    ring = SampleRing(60.0)
    ring.append(tick(0))
    ring.append(tick(1))
    ring.append(tick(4))  # 0.2 s are missing: predicted through
    assert ring.samples == 300
    ring.append(tick(8))  # 0.3 s are not
    assert ring.samples == 100
    restart = tick(9)
    quality = restart.quality.copy()
    quality[40] |= Quality.TIME_RESTART
    ring.append(replace(restart, quality=quality))
    assert ring.samples == 60
    ring.append(replace(tick(10), current_A=None))
    assert ring.samples == 100 and ring.blocks()[0].channels == ("voltage_V", "position_rad")
    ring.append(replace(tick(2), current_A=None))
    assert ring.samples == 100 and times(ring)[0] == pytest.approx(0.2)


@pytest.mark.parametrize("size", [7, 1000])
def test_it_holds_what_the_estimators_saw(size: int) -> None:
    """Every sample once and in order, whatever the blocks; the tick that is not complete yet is still to come."""
    drive = SimulatedDrive(make_settings(seed=3))
    ring = SampleRing(1.0)
    pipeline = Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), drive.info, ring=ring)
    fed = [drive.next_block(size) for _ in range(3500 // size)]
    for block in fed:
        pipeline.process(block)
    whole, kept = concatenate(fed), concatenate(ring.blocks())
    last = int(np.flatnonzero(whole.time_s == kept.time_s[-1])[0]) + 1
    assert len(whole) - last <= 100 and 900 <= len(kept) <= 1001
    for name in ("time_s", "voltage_V", "current_A", "position_rad", "sequence"):
        assert np.array_equal(getattr(kept, name), getattr(whole, name)[last - len(kept) : last])
    pipeline.reset()
    assert ring.samples == len(kept), "a reset forgets what was learned, not what was measured"
