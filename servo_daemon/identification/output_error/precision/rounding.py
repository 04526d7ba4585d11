"""What the steps of a measured current or torque make of the estimate.

A signal that stands still is rounded the same way each time: at constant speed the friction's current of a small motor
is 4.7 steps of its sensor and reads 5 for half a second. No averaging helps, and no residual shows it, since B takes it
up. So a stretch that reads the same has one error, anywhere within half a step, and stretches have independent ones.
Where noise or the motion makes a reading go to and fro between two codes, their shares tell the signal better: the mean
of a stretch that has the upper one for a share f of the time is off by no more than a step times |1/2 − f|.

Each of some draws of such errors moves the estimate to first order; what they move it by are columns of the root of its
covariance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servo_daemon.conditioning.layout import INPUT
from servo_daemon.identification.output_error.problem.inputs import input_rows
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.problem.rollout import INPUT as INPUT_COLUMN
from servo_daemon.identification.output_error.problem.setup import Recording
from servo_daemon.numerics import UNIFORM_STD
from servo_daemon.samples import F64

#: Draws: a standard deviation from so many is itself known to 1/√(2 n), 18 %.
DRAWS = 16
#: Share of differences that must be whole multiples of half a step (readings cut off toward zero are half a step from
#: it), how near to a whole number counts as one, and how many steps the smallest difference may be.
_STEPPED, _WHOLE, _COARSEST = 0.99, 0.02, 4
#: Rounding below this share of the signal is not looked at; nor is it where a reading is seldom the one before: then
#: noise has made the errors independent, and the residuals show them.
_SMALL, _STANDS = 1e-4, 0.3
#: So many changes between two codes make a stretch one that goes to and fro.
_TO_AND_FRO = 4


def step_of(values: F64) -> float:
    """The step of readings; 0 where they are no multiples of one."""
    known = np.unique(values[np.isfinite(values)])
    d = np.diff(known)
    d = d[d > 1e-9 * max(float(np.ptp(known)), 1e-300)] if len(d) else d
    if len(d) < 2:
        return 0.0
    for step in d.min() / np.arange(1, _COARSEST + 1):
        ratio = 2.0 * d / step
        if np.mean(np.abs(ratio - np.round(ratio)) < _WHOLE) > _STEPPED:
            return float(step)
    return 0.0


def rounding_sizes(values: F64) -> tuple[NDArray[np.intp], F64]:
    """Where stretches begin whose readings share an error, and 1 σ of it in each; empty where rounding does not count.

    Args:
        values: shape (n,), finite.
    """
    step, size = step_of(values), float(np.sqrt(np.mean(values**2)))
    changed = np.flatnonzero(np.abs(np.diff(values)) > 0.25 * step) + 1
    if step * UNIFORM_STD <= _SMALL * size or 1.0 - len(changed) / len(values) < _STANDS:
        return np.zeros(0, np.intp), np.zeros(0)
    begins = np.concatenate([[0], changed])
    lengths = np.diff(np.append(begins, len(values)))
    first, sizes, at = [], [], 0
    for end in _stretches(values[begins].tolist(), 1.25 * step):
        if end - at > _TO_AND_FRO:
            upper = values[begins[at:end]] > values[begins[at:end]].min() + 0.25 * step
            share = float(lengths[at:end][upper].sum() / lengths[at:end].sum())
            first.append(int(begins[at]))
            sizes.append(step * abs(1.0 - 2.0 * share))
        else:
            first += begins[at:end].tolist()
            sizes += [step] * (end - at)
        at = end
    return np.array(first, np.intp), UNIFORM_STD * np.array(sizes)


def _stretches(codes: list[float], most: float) -> Iterator[int]:
    """Ends of the longest stretches, one after the other, that reach over no more than `most`."""
    low = high = codes[0]
    for k, code in enumerate(codes):
        low, high = min(low, code), max(high, code)
        if high - low > most:
            yield k
            low = high = code
    yield len(codes)


def rounded_otherwise(problem: Problem, recordings: Sequence[Recording]) -> Iterator[Problem]:
    """The same with inputs that are off by errors as rounding may have made them, drawn anew for each; none where it
    does not count. The mean square of what they do is to be taken.

    Args:
        recordings: of the problem.
    """
    name = INPUT[problem.plant.drive]
    blocks = [r.block for r in recordings]
    readings = [np.nan_to_num(np.asarray(getattr(b, name), np.float64)) for b in blocks]
    sizes = [rounding_sizes(values) for values in readings]
    if not any(len(s) for _, s in sizes):
        return
    random = np.random.default_rng(0)
    for _ in range(DRAWS):
        added = []
        for block, (begins, size) in zip(blocks, sizes, strict=True):
            error = np.zeros(len(block))
            if len(begins):
                lengths = np.diff(np.append(begins, len(block)))
                error = np.repeat(size * random.choice((-1.0, 1.0), len(size)), lengths)
            instead: dict[str, Any] = {name: error}
            rows = input_rows(replace(block, **instead), problem.plant.drive)
            added.append(rows[:, INPUT_COLUMN])
        yield _with_added(problem, added)


def _with_added(problem: Problem, added: Sequence[F64]) -> Problem:
    def moved(rows: F64, by: F64) -> F64:
        out = rows.copy()
        out[:, INPUT_COLUMN] += by
        return out

    def of(segment: Segment) -> Segment:
        by = added[segment.recording][segment.begin : segment.begin + len(segment.rows)]
        return replace(segment, rows=moved(segment.rows, by))

    whole = tuple((x0, moved(rows, by)) for (x0, rows), by in zip(problem.whole, added, strict=False))
    return replace(problem, segments=tuple(map(of, problem.segments)), whole=whole)
