"""Which parts of a recording are fitted, which decide between models, and which only score the outcome.

Recordings are cut into short free runs, each with an initial state of its own; of every four neighbours two are fitted,
one decides and one is held out until the choice is made. Slow causes (a winding that gets warm) and events (a step of
the load) are then in all three parts: none is a time of which the others know nothing. Which is which is drawn once, by
a fixed seed: the same data get the same verdict, and no periodic motion shares the pattern.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import BadInputError
from servo_daemon.estimators.output_error import Recording

#: Free runs last between these, s; about so many of them are wanted.
_SHORTEST_S, _LONGEST_S, _WANTED = 0.4, 1.5, 48
#: A free run has at least so many samples.
_FEWEST = 40
_SHORTER = 8.0
_SEED = 20260
TRAIN, CHOICE, HELD_OUT = 0, 1, 2
_PATTERN = (TRAIN, TRAIN, CHOICE, HELD_OUT)
#: Fewer free runs leave none, or a single one, to decide and to be held out: nothing to resample.
_FEWEST_RUNS = 8


@dataclass(frozen=True, slots=True)
class Split:
    """A division of n segments.

    Attributes:
        segment_s: about the length of a segment, s.
        part: shape (n,), TRAIN, CHOICE or HELD_OUT of each.
    """

    segment_s: float
    part: NDArray[np.int64]

    def of(self, *parts: int) -> NDArray[np.intp]:
        """Indices of the segments in these parts."""
        return np.flatnonzero(np.isin(self.part, parts))


def segment_length_s(recordings: Sequence[Recording]) -> float:
    """Length of the free runs, s."""
    total = sum(float(r.block.time_s[-1] - r.block.time_s[0]) for r in recordings)
    period = max(float(np.median(np.diff(r.block.time_s))) for r in recordings)
    return max(float(np.clip(total / _WANTED, _SHORTEST_S, _LONGEST_S)), _FEWEST * period)


def shorter_s(recordings: Sequence[Recording], segment_s: float) -> float | None:
    """Length of free runs for motors that are unstable where they stand (a rotor between two detents): what is not
    known of the state grows there many-fold within the usual length. None: there is nothing shorter."""
    period = max(float(np.median(np.diff(r.block.time_s))) for r in recordings)
    shorter = max(segment_s / _SHORTER, _FEWEST * period)
    return shorter if shorter < 0.5 * segment_s else None


def divide(n: int, segment_s: float) -> Split:
    """Draw the parts of n consecutive segments.

    Raises:
        BadInputError: they are too few.
    """
    if n < _FEWEST_RUNS:
        raise BadInputError(
            f"too short to diagnose: {n} free runs of about {segment_s:.2g} s, and {_FEWEST_RUNS} are needed to "
            f"fit, to choose and to measure the gain: {_FEWEST_RUNS * segment_s:.2g} s; record twice that or more"
        )
    rng = np.random.default_rng(_SEED)
    part = np.concatenate([rng.permutation(_PATTERN) for _ in range(-(-n // len(_PATTERN)))])[:n]
    return Split(segment_s, part)
