"""Ticks of a calm drive are judged together, and no later than the first that has anything to it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest

from servo_daemon.config import DriveConfig
from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.records import Innovations
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.pipeline.publish import tracker_settings
from servo_daemon.samples import F64, Quality, SampleBlock
from servo_daemon.simulate import DEFAULT_NOMINAL, SimulatedDrive, make_settings
from servo_daemon.tracking.calm import TOGETHER
from servo_daemon.tracking.changes import search
from servo_daemon.tracking.plan.settings import Message, Resolutions
from servo_daemon.tracking.plant_tracker import PlantTracker, make_tracker

RATE_HZ, TICK = 500.0, 50
STEP_S, SECONDS = 9.0, 11.5
#: Of a search, in a tick: half of what one takes otherwise.
STEPS = 5_000


@pytest.fixture(scope="module")
def recording() -> SampleBlock:
    """A motor whose resistance steps after some calm seconds."""
    settings = make_settings(seed=5, rate_hz=RATE_HZ, ageing=(f"R=+0.2@{STEP_S:.0f}s",))
    return SimulatedDrive(settings).next_block(round(SECONDS * RATE_HZ))


def ticks(samples: SampleBlock) -> list[SampleBlock]:
    return [samples.slice(k, k + TICK) for k in range(0, len(samples), TICK)]


def tracker() -> PlantTracker:
    config = DriveConfig(nominal=dict(DEFAULT_NOMINAL))
    made = make_tracker(("voltage_V", "current_A", "position_rad"), tracker_settings(config), Resolutions())
    assert isinstance(made, PlantTracker)
    return made


@dataclass
class Ran:
    """Of each tick whether it was to be judged with later ones, and how many steps of the filter went over samples
    again; what was told."""

    waits: list[bool] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    told: list[Message] = field(default_factory=list)


def run(t: PlantTracker, samples: SampleBlock) -> Ran:
    out, update = Ran(), Ekf.update

    def counted(self: Ekf, samples: F64, *, again: bool = False) -> Innovations:
        out.steps[-1] += len(samples) if again else 0
        return update(self, samples, again=again)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Ekf, "update", counted)
        patch.setattr(search, "_STEPS_A_TICK", STEPS)
        for tick in ticks(samples):
            out.steps.append(0)
            t.take(tick)
            out.told += t.close_tick(tick)
            out.waits.append(t.waits)
    return out


@pytest.fixture(scope="module")
def ran(recording: SampleBlock) -> Ran:
    return run(tracker(), recording)


def test_ticks_wait_for_half_a_second_at_most_and_a_step_is_seen_at_once(ran: Ran) -> None:
    calm, step = ran.waits[75:85], round(STEP_S * RATE_HZ / TICK)
    assert sum(calm) == len(calm) * (TOGETHER - 1) // TOGETHER
    assert not any(ran.waits[:40]) and not any(ran.waits[step + 1 : step + 11])


def test_a_search_for_a_step_is_spread_over_ticks(ran: Ran) -> None:
    assert [data["parameter"] for kind, _, data in ran.told if kind == "parameter_jump"] == ["R"]
    searched = ran.steps[round(STEP_S * RATE_HZ / TICK) :]
    assert sum(s > STEPS / 2 for s in searched) > 4  # it would not have gone into one tick, or into four
    kept = 31 * TICK  # at most: one run more than there is room for, and one to come up to date
    assert max(searched) <= STEPS + 2 * kept


def test_a_sample_that_is_no_measurement_ends_the_wait(recording: SampleBlock) -> None:
    t, k = tracker(), 75 * TICK
    run(t, recording.slice(0, k))
    while t.waits or not t.is_calm:  # until the next tick might wait
        run(t, recording.slice(k, k + TICK))
        k += TICK
    quality = np.zeros(TICK, dtype=np.uint8)
    quality[3] = int(Quality.CURRENT_INVALID)
    assert run(t, replace(recording.slice(k, k + TICK), quality=quality)).waits == [False]


def test_a_record_is_of_its_moment_whenever_it_is_made(recording: SampleBlock) -> None:
    pipeline = Pipeline(DriveConfig(driver="simulated", nominal=dict(DEFAULT_NOMINAL)))
    pipeline.process(recording.slice(0, 3_050), rows=False)
    now, then = pipeline.now(), pipeline.current()
    pipeline.process(recording.slice(3_050, 3_500), rows=False)
    assert now is not None and now.estimate() == then != pipeline.current()


def test_what_is_published_does_not_depend_on_blocks(recording: SampleBlock) -> None:
    one, other = (Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL))) for _ in range(2))
    rows = one.process(recording)
    stays = [a.parameters is b.parameters for a, b in pairwise(rows[75:86])]
    assert sum(stays) > len(stays) // 2
    compared = 0
    for k in range(0, len(recording), 83):
        other.process(recording.slice(k, min(k + 83, len(recording))), rows=False)
        now = other.current()
        row = max((r for r in rows if now is not None and r.time_s < now.time_s), key=lambda r: r.time_s, default=None)
        if now is not None and row is not None:
            compared += 1
            assert (now.parameters, now.covariance, now.health) == (row.parameters, row.covariance, row.health)
    assert compared > 40
