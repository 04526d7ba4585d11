"""What is known of a block's samples without looking is what looking at them says."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from servo_daemon.conditioning.gaps import is_whole
from servo_daemon.samples import Quality, concatenate, make_block

PERIOD_S = 1e-3


@pytest.mark.parametrize("seed", range(20))
def test_parts_and_what_they_make_are_whole_where_no_sample_is_missing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = PERIOD_S * rng.choice([1.0, 1.5, 1.7, 400.0], 60, p=[0.9, 0.06, 0.03, 0.01])
    quality = np.where(rng.random(60) < 0.02, np.uint8(int(Quality.SATURATED)), np.uint8(0))
    block = make_block(np.cumsum(steps), quality=quality, voltage_V=rng.standard_normal(60))
    assert block.steps_within(1.0) and not block.steps_within(1e-6) and block.all_good == (not quality.any())
    cuts = [0, *sorted(rng.choice(np.arange(1, 60), 8, replace=False).tolist()), 60]
    parts = [block.slice(a, b) for a, b in pairwise(cuts)]
    for k, size in ((k, size) for k in range(len(parts)) for size in range(1, 4)):
        joined = concatenate(parts[k : k + size])
        fresh = make_block(joined.time_s.copy(), quality=joined.quality.copy(), voltage_V=joined.voltage_V)
        for last_s in (None, float(joined.time_s[0]) - PERIOD_S, float(joined.time_s[0]) - 2 * PERIOD_S):
            assert is_whole(joined, last_s, PERIOD_S) == is_whole(fresh, last_s, PERIOD_S)
        assert (joined.all_good, joined.channels) == (fresh.all_good, fresh.channels)
