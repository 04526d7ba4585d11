"""Which parts of a recording are fitted and which are only scored.

Recordings are cut into short free runs, each with an initial state of its own, and of every three neighbours one (drawn
once, by a fixed seed) is held out. Slow causes (a winding that gets warm) and events (a step of the load) are then on
both sides of the split: neither part is a time of which the other knows nothing. The seed is fixed so that the same
data get the same verdict; drawing avoids a pattern that a periodic motion could share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.estimators.output_error import Recording
from servo_daemon.estimators.output_error.problem import Problem, Segment

#: Free runs last between these, s; about so many of them are wanted.
_SHORTEST_S, _LONGEST_S, _WANTED = 0.4, 2.0, 24
#: A free run has at least so many samples.
_FEWEST = 40
_SEED = 20260
#: States that move slowly: they go on from one free run to the next.
CARRIED = ("winding_rise_K",)


def segment_length_s(recordings: Sequence[Recording]) -> float:
    """Length of the free runs, s."""
    total = sum(float(r.block.time_s[-1] - r.block.time_s[0]) for r in recordings)
    period = max(float(np.median(np.diff(r.block.time_s))) for r in recordings)
    return max(float(np.clip(total / _WANTED, _SHORTEST_S, _LONGEST_S)), _FEWEST * period)


def held_out(n: int) -> NDArray[np.bool_]:
    """Which of n consecutive segments are only scored, shape (n,): one of every three."""
    rng = np.random.default_rng(_SEED)
    mask = np.zeros(n, dtype=bool)
    for begin in range(0, n, 3):
        mask[begin + rng.integers(min(3, n - begin))] = True
    if n > 1 and mask.all():
        mask[0] = False
    return mask


@dataclass(frozen=True, slots=True)
class Split:
    """Two problems over the same segments: each sees its own part, the other's samples have no weight."""

    train: Problem
    test: Problem
    mask: NDArray[np.bool_]


def divided(problem: Problem, mask: NDArray[np.bool_]) -> Split:
    """The problem split by segments.

    Args:
        mask: shape (segments,), True: held out.
    """
    return Split(_without(problem, mask), _without(problem, ~mask), mask)


def _without(problem: Problem, blind: NDArray[np.bool_]) -> Problem:
    segments = tuple(_blinded(s) if b else s for s, b in zip(problem.segments, blind, strict=True))
    return replace(problem, segments=segments)


def _blinded(segment: Segment) -> Segment:
    return replace(segment, valid=np.zeros_like(segment.valid))
