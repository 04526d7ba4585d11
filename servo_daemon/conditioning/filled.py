"""Samples in place of those that are missing in a short gap.

A drive that loses single samples does not stop: its controller goes on changing the voltage. Held over the gap, the
last voltage that arrived would be wrong for half of it and more; where the winding is fast, the current after the gap
is that of a voltage nobody saw; and no window of a regression would be free of gaps. On the straight line between its
neighbours a missing voltage is wrong by chance only: of a voltage that changes at random by steps of variance s², by
s²/2 where the steps add up, by ¾ s² where they do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import CHANNELS, F64, Quality, SampleBlock, concatenate

#: Variance of a voltage on the line, as a share of the mean square of its steps from sample to sample.
LINE_VAR = 0.75
#: Flags of the interval before a sample, not of the sample itself.
_GAP = np.uint8(int(Quality.GAP_BEFORE))
_BEFORE = np.uint8(int(Quality.GAP_BEFORE | Quality.TIME_RESTART))


def filled(
    block: SampleBlock, before: SampleBlock | None, gaps: Sequence[int], period_s: float
) -> tuple[SampleBlock, NDArray[np.bool_]]:
    """The block with samples on the straight lines across its gaps.

    Args:
        before: the sample before the block; None: nothing is put in before its first one.
        gaps: indices of samples before which some are missing.
        period_s: usual distance of two samples.

    Returns:
        The block, each new sample with the quality flags of both neighbours; and which samples are new.
    """
    extended = block if before is None else concatenate([before, block])
    shift, time_s = len(extended) - len(block), extended.time_s
    at = np.array([k + shift for k in gaps if k + shift > 0], dtype=np.intp)
    missing = np.maximum(np.round((time_s[at] - time_s[at - 1]) / period_s).astype(np.intp) - 1, 0)
    where = np.repeat(at, missing)
    if len(where) == 0:
        return block, np.zeros(len(block), dtype=bool)
    # 1 .. m of each gap of m missing samples, over m + 1.
    number = np.arange(len(where)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    share = number / (np.repeat(missing, missing) + 1.0)

    def line(values: F64) -> F64:
        new = values[where - 1] + share * (values[where] - values[where - 1])
        return np.asarray(np.insert(values, where, new))[shift:]

    quality = extended.quality.copy()
    quality[at[missing > 0]] &= ~_GAP  # the gap is filled
    of_new = (quality[where - 1] | quality[where]) & ~_BEFORE
    new = np.insert(np.zeros(len(extended), dtype=bool), where, True)[shift:]
    channels: dict[str, Any] = {n: None if (a := getattr(extended, n)) is None else line(a) for n in CHANNELS}
    return (
        SampleBlock(
            line(time_s),
            np.insert(extended.sequence, where, extended.sequence[where])[shift:],
            np.insert(quality, where, of_new)[shift:],
            block.host_time_s,
            current_mean=block.current_mean,
            **channels,
        ),
        new,
    )
