"""The recordings of a diagnosis, and which of their samples fit and choice may see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.trial.split import HELD_OUT, Split, divide, divide_seen
from servo_daemon.identification.output_error import Recording
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.problem.setup import make_problem, state_scale, without_dead_current


@dataclass(frozen=True, slots=True)
class Data:
    """Recordings and their split, shared by all trials.

    Attributes:
        recordings: the captures, marked where fit and choice may look: nowhere in the part that is held out.
        fixed: parameters held in every model, natural units.
        split: of their segments.
    """

    recordings: tuple[Recording, ...]
    fixed: Mapping[str, float]
    split: Split

    @property
    def longest(self) -> int:
        """Which recording has most samples."""
        return int(np.argmax([len(r.block) for r in self.recordings]))

    @classmethod
    def of(
        cls, recordings: Sequence[Recording], fixed: Mapping[str, float], effects: tuple[str, ...], segment_s: float
    ) -> Data:
        """Recordings cut into free runs of about this length, and these divided. What is marked already stays as it is:
        runs that are mostly unseen are held out.

        Raises:
            BadInputError: see `make_problem`, or too few runs.
        """
        recordings = without_dead_current(recordings)
        segments = make_problem(_unmarked(recordings), effects, dict(fixed), segment_s=segment_s).segments
        marks = [r.seen for r in recordings if r.seen is not None]
        if len(marks) == len(recordings):
            seen = np.array([np.mean(_there(s, marks)) > 0.5 for s in segments])
            return cls(tuple(recordings), fixed, divide_seen(seen, segment_s))
        split = divide(len(segments), segment_s, [k for k, s in enumerate(segments) if s.begin == 0])
        marks = [np.ones(len(r.block), dtype=bool) for r in recordings]
        for k in split.of(HELD_OUT).tolist():
            _there(segments[k], marks)[:] = False
        return cls(tuple(replace(r, seen=m) for r, m in zip(recordings, marks, strict=True)), fixed, split)

    def cut(self, effects: tuple[str, ...], segment_s: float) -> Data:
        """The same with free runs of another length."""
        return Data.of(self.recordings, self.fixed, effects, segment_s)

    @property
    def full(self) -> Data:
        """The data with nothing held out, for what is published when all is decided."""
        return replace(self, recordings=_unmarked(self.recordings))

    def problem(self, effects: tuple[str, ...], held: Mapping[str, float]) -> Problem:
        """All free runs, each valid in its own part only: those held out where nothing else may look, the others where
        it may.

        Args:
            held: parameters that are not fitted, natural units, beside `fixed`.

        Raises:
            BadInputError: see `make_problem`.
        """
        every = make_problem(
            _unmarked(self.recordings), effects, {**self.fixed, **held}, segment_s=self.split.segment_s
        )
        marks = [np.ones(len(r.block), dtype=bool) if r.seen is None else r.seen for r in self.recordings]
        scales = [state_scale(r.seen_block, every.plant) for r in self.recordings]
        segments = tuple(
            replace(s, valid=s.valid & (_there(s, marks) != (part == HELD_OUT))[:, None], x0_scale=scales[s.recording])
            for s, part in zip(every.segments, self.split.part.tolist(), strict=True)
        )
        return replace(every, segments=segments)


def begun(recordings: tuple[Recording, ...], most: int) -> tuple[Recording, ...]:
    """The first samples of each, so many in all; themselves where there are no more."""
    samples = sum(len(r.block) for r in recordings)
    if samples <= most:
        return recordings
    return tuple(_begin(r, max(most * len(r.block) // samples, 1)) for r in recordings)


def _begin(recording: Recording, samples: int) -> Recording:
    seen = None if recording.seen is None else recording.seen[:samples]
    return replace(recording, block=recording.block.slice(0, samples), seen=seen)


def _unmarked(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    return tuple(replace(r, seen=None) for r in recordings)


def _there(segment: Segment, marks: Sequence[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """A segment's own samples of what is marked in its recording: a view, shape (n,)."""
    return marks[segment.recording][segment.begin : segment.begin + len(segment.rows)]
