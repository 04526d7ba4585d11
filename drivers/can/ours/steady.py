"""The common case of our own CAN frames, in few NumPy calls: nothing is missing and every Sync confirms what is known.

Eight drives on one bus make four hundred blocks a second of some twenty samples each, where the number of NumPy calls
is the cost, not the number of samples. So what needs no knowledge of the drive is done once for all the frames that
were received together (`sample_runs`), and what is left for each drive is to recognise that its samples go on as they
should and to add where they begin (`follow`). About anything else `follow` says None, nothing has been changed, and
`can_own` and `can_dating` take the frames apart with care. What it accepts has bit for bit the values it would have
there (a test compares).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from drivers.can.decode import CLASSIC_BYTES, FrameBatch
from drivers.can.ours.dating import U16, Last
from drivers.can.ours.wire import AT_LIMIT, FIRST_DRIVE, LAST_DRIVE, POSITION, SAMPLE_ID, TIME
from servo_daemon.samples import F64, U8

#: Steps of time are read as signed words together with those of position. Drives slower than 46 Hz are never steady.
MAX_STEP_US = 32_767

_WORDS = np.dtype("<u2")
_ZERO = np.zeros(1, np.int64)


def words_of(data: U8) -> U16:
    """Eight-byte frames, shape (n, 8), as their words, shape (n, 4)."""
    return data.view(_WORDS).astype(np.uint16, copy=False)


class Run(NamedTuple):
    """The Samples of one drive among all that were received together: columns start..stop-1 of `raw`.

    Attributes:
        raw: shape (4, all): voltage and current as sent; position in counts and time in µs, of which only the
            differences within the run mean something. Whole numbers, exact up to 2^53.
        first: the words of its first Sample.
        longest_us: the longest step of time within the run; a repeated time is a step of 65,536.
        at_limit: whether any voltage or current may be no number, in this run or another.
    """

    raw: F64
    start: int
    stop: int
    first: Sequence[int]
    longest_us: int
    at_limit: bool


class Claim(NamedTuple):
    """What a Sync says of the Sample in row `row`: whole time in µs, running number, upper word of the position."""

    row: int
    time_us: int
    number: int
    position_high: int


def sample_runs(whole: FrameBatch) -> Mapping[int, Run]:
    """The Samples of all drives in frames received together, by key; none where a drive's do not lie in a row."""
    mine = (whole.keys - SAMPLE_ID).view(np.uint64) <= LAST_DRIVE - FIRST_DRIVE
    if whole.shortest < CLASSIC_BYTES:
        mine &= whole.lengths >= CLASSIC_BYTES
    keys = whole.keys[mine]
    if not len(keys):
        return {}
    frames = np.ascontiguousarray(whole.data[:, :CLASSIC_BYTES]).view(np.uint64)[mine, 0]
    words = words_of(frames.view(np.uint8).reshape(-1, CLASSIC_BYTES))
    starts = np.concatenate([_ZERO, np.flatnonzero(keys[1:] != keys[:-1]) + 1])
    ids = keys[starts].tolist()
    if len(set(ids)) < len(ids):
        return {}
    columns = words.T
    raw, steps = np.empty((4, len(keys))), np.zeros((2, len(keys)), np.uint16)
    np.subtract(columns[POSITION:, 1:], columns[POSITION:, :-1], out=steps[:, 1:])
    raw[:POSITION] = columns[:POSITION].view(np.int16)
    raw[POSITION:] = steps.view(np.int16)
    np.add.accumulate(raw[POSITION:], axis=1, out=raw[POSITION:])
    at_limit = bool(np.maximum.reduce(np.abs(raw[:POSITION]), axis=None) >= AT_LIMIT)
    beyond_one_us = steps[1] - np.uint16(1)
    beyond_one_us[starts] = 0  # from one drive to the next
    longest = np.maximum.reduceat(beyond_one_us, starts).tolist()
    edges = [*starts.tolist(), len(keys)]
    return {
        key: Run(raw, edges[k], edges[k + 1], first, longest[k] + 1, at_limit)
        for k, (key, first) in enumerate(zip(ids, words[starts].tolist(), strict=True))
    }


def follow(run: Run, last: Last, period_s: float, claims: Sequence[Claim], origin: F64) -> F64 | None:
    """A run's samples continued from the last one before it, or None where that takes more than adding up.

    Args:
        claims: what the Syncs say of rows of this run, counted from its start.
        origin: shape (4, 1), zeros in the first two rows; for use here.

    Returns:
        Shape (4, n): voltage and current as sent, position in counts and time in µs, both continuous.
    """
    _, _, position, time_us = run.first
    step_us = (time_us - last.time_us) & 0xFFFF
    longest_us = max(step_us, run.longest_us)
    if not step_us or longest_us >= 1.5e6 * period_s or longest_us > MAX_STEP_US:
        return None
    moved = ((position - last.position + 0x8000) & 0xFFFF) - 0x8000
    raw = run.raw[:, run.start : run.stop]
    position_here, time_here = raw[POSITION:, 0].tolist()
    origin[POSITION] = last.position + moved - position_here
    origin[TIME] = last.time_us + step_us - time_here
    raw = raw + origin
    for claim in claims:
        if not _confirms(claim, raw, last):
            return None
    return raw


def _confirms(claim: Claim, raw: F64, last: Last) -> bool:
    """Whether a Sync finds nothing to correct."""
    number = last.sequence + 1 + claim.row - last.count_offset
    return (
        int(raw[TIME, claim.row]) & 0xFFFF_FFFF == claim.time_us
        and (int(raw[POSITION, claim.row]) >> 16) & 0xFFFF == claim.position_high
        and number & 0xFFFF == claim.number
    )
