"""How far apart samples are on a CAN link that sends no time, learnt from when its frames were received."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from typing import Any

import can
import numpy as np
import pytest

from drivers.can.decode import batch_of
from drivers.can.listener import BusListener
from drivers.can.pace import PacedListener, heard_pace
from drivers.registry import make_driver
from servo_daemon.samples import Quality, SampleBlock

BUS = {"interface": "virtual", "channel": "unused"}
#: Codes of an MIT mode actuator at rest: any frame will do.
FEEDBACK = bytes.fromhex("0180008007ff8000")


def mit(**options: Any) -> PacedListener:
    driver = make_driver("mit", "axis1", {**BUS, "model": "AK80-9", **options})
    assert isinstance(driver, PacedListener)
    return driver


def heard(driver: BusListener, stamp_s: Iterable[float], key: int = 0, data: bytes = FEEDBACK) -> list[SampleBlock]:
    """Frames with these receive times, taken from the bus every 40 ms."""
    blocks: list[SampleBlock] = []
    waiting: list[can.Message] = []
    for at in stamp_s:
        if waiting and at - waiting[0].timestamp > 0.04:
            blocks += driver._frames.feed(batch_of(waiting, waiting[-1].timestamp, 1e9 + waiting[-1].timestamp))
            waiting = []
        waiting.append(can.Message(timestamp=at, arbitration_id=key, data=data, is_extended_id=False))
    return blocks + driver._frames.feed(batch_of(waiting, waiting[-1].timestamp, 1e9 + waiting[-1].timestamp))


def let_go(sent_s: np.ndarray, every_s: float) -> np.ndarray:
    """As an adapter lets frames go: all that waited at once, 50 µs apart, at times that are no rate of its own."""
    rng = np.random.default_rng(3)
    gates = np.cumsum(every_s * rng.uniform(0.5, 1.5, int(2 * sent_s[-1] / every_s) + 2))
    at = np.searchsorted(gates, sent_s)
    first = np.searchsorted(at, at)
    return gates[at] + 5e-5 * (np.arange(len(at)) - first)


def times(blocks: list[SampleBlock]) -> np.ndarray:
    return np.concatenate([b.time_s for b in blocks])


@pytest.mark.parametrize("period_s", [1e-3, 2e-3, 0.02])
def test_frames_in_bunches_are_even_and_their_period_is_told(period_s: float) -> None:
    driver = mit()
    n = round(8.0 / period_s)
    blocks = heard(driver, let_go(period_s * np.arange(n), 0.016))
    assert sum(map(len, blocks)) == n
    learnt_s = driver.info.sample_period_s
    assert learnt_s == pytest.approx(period_s, rel=0.01)
    assert driver.learnt is not None and "its times are even" in driver.learnt and "comes every" in driver.learnt
    assert np.diff(times(blocks)) == pytest.approx(period_s, rel=0.04)


def test_stamps_that_need_no_help_are_kept() -> None:
    driver = mit()
    stamp_s = 0.005 * np.arange(600) + 2e-5 * np.sin(np.arange(600))
    blocks = heard(driver, stamp_s)
    assert times(blocks) == pytest.approx(stamp_s - stamp_s[0], abs=1e-9)
    assert driver.info.sample_period_s == pytest.approx(0.005, rel=1e-3)


def wandering(n: int) -> np.ndarray:
    """A sender that waits anew each time, longer or shorter."""
    return np.cumsum(0.005 * np.random.default_rng(5).uniform(0.5, 1.5, n))


def test_of_a_sender_without_a_rate_the_stamps_of_single_frames_are_kept() -> None:
    driver = mit()
    stamp_s = wandering(800)
    blocks = heard(driver, stamp_s)
    assert times(blocks) == pytest.approx(stamp_s - stamp_s[0], abs=1e-9)
    assert driver.learnt is not None and "no steady rate" in driver.learnt


def stalled(stamp_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A third of the time the listener gets no time: what comes meanwhile is stamped when it is over."""
    out, t = stamp_s.copy(), 0.0
    while t < stamp_s[-1]:
        t += rng.exponential(0.15)
        ends = t + rng.uniform(0.02, 0.13)
        late = (out >= t) & (out < ends)
        out[late] = ends + 5e-5 * np.arange(np.count_nonzero(late))
        t = ends
    return np.maximum.accumulate(out)


def test_a_listener_that_stalls_takes_nothing_from_a_steady_rate_and_gives_none_to_others() -> None:
    steady, others = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        for sent_s, found in ((0.002 * np.arange(750), steady), (np.cumsum(rng.exponential(0.005, 300)), others)):
            pace = heard_pace(stalled(let_go(sent_s, 0.016), rng))
            assert pace is not None
            found.append(pace.steady)
    assert np.mean(steady) > 0.95 and np.mean(others) < 0.1


def test_without_a_rate_and_in_bunches_nothing_is_read_and_the_words_say_why() -> None:
    driver = mit()
    events_s = np.cumsum(np.random.default_rng(7).exponential(0.005, 1600))
    assert heard(driver, let_go(events_s, 0.016)) == []
    assert driver.remark is not None and "in bunches and at no steady rate" in driver.remark


def test_a_sender_that_finds_its_rate_later_is_read_from_then_on() -> None:
    """Ten minutes of chance, then 200 Hz: what came long ago has no say in it."""
    driver = mit()
    chance_s = np.cumsum(np.random.default_rng(7).exponential(0.005, 120_000))
    sent_s = np.concatenate([chance_s, chance_s[-1] + 0.005 * np.arange(1, 24_000)])
    blocks = heard(driver, let_go(sent_s, 0.016))
    assert driver.info.sample_period_s == pytest.approx(0.005, rel=0.01) and len(blocks) > 0


@pytest.mark.parametrize(("told_s", "read"), [(0.005, True), (0.01, False), (0.0055, False)])
def test_a_period_that_is_not_the_drives_is_refused(told_s: float, read: bool) -> None:
    driver = mit(period_s=told_s)
    assert bool(heard(driver, let_go(0.005 * np.arange(800), 0.016))) == read
    assert (driver.remark is None) == read
    assert read or "comes every 5 ms" in str(driver.remark) or "comes every 4.9" in str(driver.remark)


def odrive() -> BusListener:
    driver = make_driver("odrive", "axis1", BUS)
    assert isinstance(driver, BusListener)
    return driver


@pytest.mark.parametrize(
    ("make", "key", "data"), [(mit, 0, FEEDBACK), (odrive, 5 << 5 | 9, struct.pack("<ff", 1.0, 0.0))]
)
def test_a_rate_that_is_changed_is_learnt_anew(make: Callable[[], BusListener], key: int, data: bytes) -> None:
    """200 Hz, from 6 s on 80: samples at the old distance end within a second, and time begins anew."""
    driver = make()
    sent_s = np.concatenate([0.005 * np.arange(1200), 6.0 + 0.0125 * np.arange(600)])
    blocks = heard(driver, let_go(sent_s, 0.016), key, data)
    restarts = [k for k, b in enumerate(blocks) if b.quality[0] & Quality.TIME_RESTART]
    assert len(restarts) == 1
    assert times(blocks[: restarts[0]])[-1] < 7.5
    assert np.diff(times(blocks[restarts[0] :])) == pytest.approx(0.0125, rel=0.04)
    assert driver.info.sample_period_s == pytest.approx(0.0125, rel=0.01)
