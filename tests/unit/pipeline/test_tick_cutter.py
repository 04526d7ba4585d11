"""Where ticks begin, whatever the blocks: the usual short ways give what the definition does."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.pipeline.stream import TickCutter
from servo_daemon.samples import make_block
from servo_daemon.tracking.plan.settings import TICK_S


@pytest.mark.parametrize("size", [1, 7, 100, 130, 1000])
@pytest.mark.parametrize("period_s", [1e-3, 1e-2, 0.07])
def test_every_sample_is_in_its_tick(size: int, period_s: float) -> None:
    rng = np.random.default_rng(5)
    time_s = 3.0 + np.cumsum(period_s * rng.uniform(0.5, 1.5, 1500))
    time_s[700:] += 0.35  # a gap over several ticks
    block, cutter = make_block(time_s), TickCutter()
    seen, tick = [], 0
    for a in range(0, len(block), size):
        for segment in cutter.cut(block.slice(a, a + size)):
            tick += segment.closes_tick
            seen += [(float(t), tick) for t in segment.block.time_s]
    ticks = np.floor((time_s - time_s[0]) / TICK_S + 1e-6)
    expected = np.concatenate([[0], np.cumsum(np.diff(ticks) > 0)])
    np.testing.assert_array_equal(np.array(seen), np.column_stack([time_s, expected]))
