"""Which parts of a recording are fitted, which decide between models, and which only score the outcome.

Recordings are cut into short free runs, each with an initial state of its own; of every four neighbours two are fitted,
one decides and one is held out: neither a fit nor a choice sees it, and it only measures. Slow causes (a winding that
gets warm) and events (a step of the load) are then in all three parts: none is a time of which the others know nothing.
Which is which is drawn once, by a fixed seed: the same data get the same verdict, and no periodic motion shares the
pattern. What a recording begins with is never held out: a model that runs through all of it begins there, in what may
be a start like no other time.

A dozen runs have no third part worth the name: what would be held out decides, too, and the gain is that of the
deciding part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import BadInputError
from servo_daemon.identification.output_error import Recording
from servo_daemon.numerics import sample_period

#: Free runs last between these, s; about so many of them are wanted (chosen; not tried).
_SHORTEST_S, _LONGEST_S, _WANTED = 0.4, 1.5, 48
#: A free run has at least so many samples (chosen; not tried).
_FEWEST = 40
#: Runs that are shorter than the search's are so many times shorter (chosen; not tried).
_SHORTER = 8.0
_SEED = 20260
TRAIN, CHOICE, HELD_OUT = 0, 1, 2
#: In no part: seen by what runs through whole recordings, not by free runs.
BEGUN = 3
_SEEN = (TRAIN, TRAIN, CHOICE)
_PATTERN = (*_SEEN, HELD_OUT)
#: Fewer free runs leave a single one to decide: nothing to resample.
_FEWEST_RUNS = 8
#: Of fewer that are held out resampling makes no interval (chosen; not tried).
_FEWEST_MEASURED = 3


@dataclass(frozen=True, slots=True)
class Split:
    """A division of n segments.

    Attributes:
        segment_s: about the length of a segment, s.
        part: shape (n,), TRAIN, CHOICE, HELD_OUT or BEGUN of each.
    """

    segment_s: float
    part: NDArray[np.int64]

    def of(self, *parts: int) -> NDArray[np.intp]:
        """Indices of the segments in these parts."""
        return np.flatnonzero(np.isin(self.part, parts))

    @property
    def measuring(self) -> int:
        """The part that the gain is measured on."""
        return HELD_OUT if (self.part == HELD_OUT).any() else CHOICE

    @property
    def before_measuring(self) -> tuple[int, ...]:
        """The parts that models are fitted to whose gain is measured."""
        return (TRAIN, CHOICE) if self.measuring == HELD_OUT else (TRAIN,)


def segment_length_s(recordings: Sequence[Recording]) -> float:
    """Length of the free runs, s."""
    total = sum(float(r.block.time_s[-1] - r.block.time_s[0]) for r in recordings)
    period = max(sample_period(r.block.time_s) for r in recordings)
    return max(float(np.clip(total / _WANTED, _SHORTEST_S, _LONGEST_S)), _FEWEST * period)


def shorter_s(recordings: Sequence[Recording], segment_s: float) -> float | None:
    """Length of free runs for motors that are unstable where they stand (a rotor between two detents): what is not
    known of the state grows there many-fold within the usual length. None: there is nothing shorter."""
    period = max(sample_period(r.block.time_s) for r in recordings)
    shorter = max(segment_s / _SHORTER, _FEWEST * period)
    return shorter if shorter < 0.5 * segment_s else None


def divide(n: int, segment_s: float, begins: Sequence[int] = (0,)) -> Split:
    """Draw the parts of n consecutive segments.

    Args:
        begins: which of them begin a recording.

    Raises:
        BadInputError: they are too few.
    """
    if n < _FEWEST_RUNS:
        raise BadInputError(
            f"too short to diagnose: {n} free runs of about {segment_s:.2g} s, and {_FEWEST_RUNS} are needed to "
            f"fit and to choose: {_FEWEST_RUNS * segment_s:.2g} s; record twice that or more"
        )
    part = _drawn(n, _PATTERN)
    part[[k for k in begins if part[k] == HELD_OUT]] = BEGUN
    if np.count_nonzero(part == HELD_OUT) < _FEWEST_MEASURED:
        part[part == HELD_OUT] = CHOICE
    return Split(segment_s, part)


def divide_seen(seen: NDArray[np.bool_], segment_s: float) -> Split:
    """Draw fit and choice of segments among those that may be seen; the others stay held out.

    Args:
        seen: shape (n,).
    """
    part = np.full(len(seen), HELD_OUT)
    part[seen] = _drawn(int(seen.sum()), _SEEN)
    return Split(segment_s, part)


def _drawn(n: int, pattern: Sequence[int]) -> NDArray[np.int64]:
    """The pattern again and again, each time in another order; shape (n,)."""
    rng = np.random.default_rng(_SEED)
    return np.concatenate([rng.permutation(pattern) for _ in range(-(-n // len(pattern)))])[:n].astype(np.int64)
