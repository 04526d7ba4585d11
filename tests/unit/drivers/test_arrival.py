"""Times of samples that carry none: the clock is that of the device, not that of the reads."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.serial.arrival import GAP_S, ArrivalClock
from servo_daemon.samples import Quality, SampleBlock, concatenate, make_block


def _reads(period_s: float, seconds: float, spacing_s: float = 0.04, pause: tuple[float, float] = (9e9, 0.0)):
    """Blocks as a reader that wakes every `spacing_s` gets them; the device is silent for `pause` (from, how long)."""
    random = np.random.default_rng(3)
    k, read_s, blocks, taken = 0, 0.0, [], []
    while read_s < seconds:
        read_s += spacing_s + random.uniform(0.0, 0.01)
        new = []
        while k * period_s + (pause[1] if k * period_s >= pause[0] else 0.0) <= read_s:
            new.append(k)
            k += 1
        if new:
            n = np.array(new)
            blocks.append(make_block(np.zeros(len(n)), sequence=n.astype(np.int64), host_time_s=100.0 + read_s))
            taken.append(n)
    return blocks, np.concatenate(taken)


def _dated(clock: ArrivalClock, blocks: list[SampleBlock]) -> SampleBlock:
    return concatenate([d for b in blocks if (d := clock.date(b)) is not None])


@pytest.mark.parametrize("period_s", [1e-3, 4.2e-3, 0.02])
@pytest.mark.parametrize("told", [True, False])
def test_the_steps_are_those_of_the_device(period_s: float, told: bool) -> None:
    blocks, number = _reads(period_s, 20.0)
    clock = ArrivalClock(period_s if told else None)
    block = _dated(clock, blocks)
    assert len(block) == len(number) and clock.lost == 0
    steps = np.diff(block.time_s)
    assert (steps > 0).all()
    settled = steps[len(steps) // 2 :]
    np.testing.assert_allclose(settled.mean(), period_s, rtol=2e-3)
    np.testing.assert_allclose(settled, period_s, rtol=0.05)


def test_a_told_period_that_is_a_little_wrong_is_followed() -> None:
    blocks, _ = _reads(1e-3, 30.0)
    block = _dated(ArrivalClock(1.005e-3), blocks)
    settled = block.time_s[len(block) // 2 :]
    np.testing.assert_allclose(np.diff(settled).mean(), 1e-3, rtol=1e-3)


def test_silence_is_a_gap_and_counted() -> None:
    blocks, _ = _reads(2e-3, 10.0, pause=(5.0, 4 * GAP_S))
    clock = ArrivalClock()
    block = _dated(clock, blocks)
    assert clock.lost == pytest.approx(4 * GAP_S / 2e-3, rel=0.1)
    (at,) = np.flatnonzero(block.quality & Quality.GAP_BEFORE)
    assert block.time_s[at] - block.time_s[at - 1] == pytest.approx(4 * GAP_S, rel=0.1)
    assert block.sequence[at] - block.sequence[at - 1] == clock.lost + 1
