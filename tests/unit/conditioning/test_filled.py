"""Samples put in place of those that are missing."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.conditioning.filled import filled
from servo_daemon.conditioning.gaps import gaps, short_gaps
from servo_daemon.samples import Quality, SampleBlock, make_block

PERIOD_S = 1e-3


def block(*number: int, quality: dict[int, Quality] | None = None) -> SampleBlock:
    """The samples of these numbers; every channel is a straight line."""
    n = np.array(number, dtype=np.float64)
    flags = np.array([int((quality or {}).get(k, Quality.GOOD)) for k in number], dtype=np.uint8)
    return make_block(n * PERIOD_S, quality=flags, voltage_V=2.0 * n, current_A=-n, position_rad=0.1 * n)


def test_what_is_missing_is_on_the_straight_line() -> None:
    """One between 1 and 3, two between 3 and 6."""
    out, new = filled(block(0, 1, 3, 6, 7), None, [2, 3], PERIOD_S)
    assert new.tolist() == [False, False, True, False, True, True, False, False]
    assert out.time_s == pytest.approx(np.arange(8) * PERIOD_S)
    assert out.voltage_V == pytest.approx(2.0 * np.arange(8))
    assert out.position_rad == pytest.approx(0.1 * np.arange(8))


def test_a_gap_before_the_first_sample_is_filled_from_the_last_one_before() -> None:
    out, new = filled(block(5, 6), block(3), [0], PERIOD_S)
    assert new.tolist() == [True, False, False]
    assert out.current_A == pytest.approx([-4.0, -5.0, -6.0])
    same, none = filled(block(5, 6), None, [0], PERIOD_S)
    assert len(same) == 2
    assert not none.any()


def test_what_was_filled_is_no_gap_any_more_and_no_better_than_its_neighbours() -> None:
    """A driver says of the sample after a gap that there was one; the regressions leave out every window with such."""
    holed = block(0, 1, 3, 4, quality={1: Quality.CURRENT_INVALID, 3: Quality.GAP_BEFORE})
    assert short_gaps(holed, None, PERIOD_S) == [2]
    out, new = filled(holed, None, [2], PERIOD_S)
    assert gaps(out, None, PERIOD_S) == {}
    assert out.quality[new].tolist() == [int(Quality.CURRENT_INVALID)]
