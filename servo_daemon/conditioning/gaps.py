"""Where samples are missing, and where the plant's state is lost by it."""

from __future__ import annotations

import numpy as np

from servo_daemon.samples import F64, Quality, SampleBlock

#: A gap longer than this leaves the plant's states unknown; a shorter one is predicted through (chosen; not tried).
LONG_GAP_S = 0.25
#: Samples further apart than this many periods have lost some between them: no regular drive's jitter is as large
#: (chosen; not tried).
_GAP_PERIODS = 1.6
#: Up to this many periods a gap is filled (`filled`); beyond, what the voltage did meanwhile nobody knows (chosen; not
#: tried).
_SHORT_GAP_PERIODS = 3.5
#: Plain numbers: members of an enumeration are slow to reach.
RESTART, GAP = int(Quality.TIME_RESTART), int(Quality.GAP_BEFORE)


def distances(time_s: F64, last_s: float) -> F64:
    """Of each sample from the one before it, s, shape (n,)."""
    out = np.empty(len(time_s))
    out[0] = time_s[0] - last_s
    np.subtract(time_s[1:], time_s[:-1], out=out[1:])
    return out


def _within(block: SampleBlock, last_s: float | None, most_s: float) -> bool:
    """Whether no sample is further from the one before it, s."""
    return (last_s is None or float(block.time_s[0]) - last_s <= most_s) and block.steps_within(most_s)


def is_whole(block: SampleBlock, last_s: float | None, period_s: float | None) -> bool:
    """Whether there is nothing for `breaks` and `gaps` to find: the usual case, told by one look."""
    if period_s is None or not block.all_good:
        return False
    return _within(block, last_s, min(LONG_GAP_S, _GAP_PERIODS * period_s))


def breaks(block: SampleBlock, last_s: float | None) -> list[int]:
    """Indices of samples before which the plant's state is lost: restarts and long gaps."""
    if block.all_good and _within(block, last_s, LONG_GAP_S):
        return []  # the usual case, without looking closer
    previous = np.concatenate([[block.time_s[0] if last_s is None else last_s], block.time_s[:-1]])
    lost = (block.time_s - previous > LONG_GAP_S) | ((block.quality & RESTART) != 0)
    return [int(k) for k in np.flatnonzero(lost)]


def gaps(block: SampleBlock, last_s: float | None, period_s: float | None) -> dict[int, bool]:
    """Indices of samples before which others are missing, as the driver says or as their times show, and whether the
    gap is a short one.

    Args:
        last_s: time of the sample before the block; None: there is none.
        period_s: usual distance of two samples; None: not known yet.
    """
    if period_s is None:
        return dict.fromkeys(np.flatnonzero(block.quality & GAP).tolist(), False)
    if block.all_good and _within(block, last_s, _GAP_PERIODS * period_s):
        return {}  # the usual case
    distance = distances(block.time_s, float(block.time_s[0]) if last_s is None else last_s)
    missing = ((block.quality & GAP) != 0) | (distance > _GAP_PERIODS * period_s)
    return {k: bool(distance[k] <= _SHORT_GAP_PERIODS * period_s) for k in np.flatnonzero(missing).tolist()}


def short_gaps(block: SampleBlock, last_s: float | None, period_s: float | None) -> list[int]:
    """Indices of samples before which so few are missing that others can be put in their place."""
    holes = gaps(block, last_s, period_s)
    if not holes:
        return []
    cuts = breaks(block, last_s)
    return [k for k, short in holes.items() if short and k not in cuts]
