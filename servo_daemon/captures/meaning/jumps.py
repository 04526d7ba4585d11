"""Counters that start again: positions that jump by a whole turn, or by the 65,536 of a full counter, in one sample."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servo_daemon.captures.capture.model import Capture
from servo_daemon.captures.meaning.finding import Finding, column_name, mend
from servo_daemon.numerics import sample_period
from servo_daemon.samples import F64, GAP_FACTOR

#: A jump is more than this share of all that the position covers, and nothing else comes to half of it.
_JUMP = 0.5
#: Or it is one of so few steps that are so many times the largest of all others: a position that was set to zero.
_FEW_JUMPS, _FAR = 4, 20.0
#: A counter has more values than this.
_FEW_STEPS = 8
#: A counter's range from what is seen at a jump, relative: the motion within one sample is only guessed.
_NEAR = 0.02
#: Bits of counters.
_BITS = (8, 10, 12, 13, 14, 15, 16, 18, 20, 24, 32)
_DEGREES = 360.0
#: Ranges of angles.
_TURNS = (
    (2 * math.pi, "a turn in rad"),
    (math.pi, "half a turn"),
    (4 * math.pi, "two turns"),
    (_DEGREES, "a turn in degrees"),
)


def jump_findings(capture: Capture) -> list[Finding]:
    """Where the position starts again; empty where it goes on."""
    position = capture.position_rad
    if position is None or len(position) < 8:
        return []
    sizes = _jumps(position, _turned_in_gaps(capture.time_s, position))
    if not len(sizes):
        return []
    if float(np.median(sizes)) < _FEW_STEPS * _resolution(position):
        return []  # a shaft that is held, and its encoder between two edges
    modulus, what = _range_of(float(np.median(sizes)), capture, position)
    name = column_name(capture, "position_rad")
    times = "once" if len(sizes) == 1 else f"{len(sizes)} times"
    text = f"column {name} jumps by {float(np.median(sizes)):,.6g} from one sample to the next, {times}: {what}"
    return [Finding("position_rad", f"{text}. {_mend(capture, modulus, _whole(position))}", "capture")]


def _mend(capture: Capture, modulus: float, whole: bool) -> str:
    """With the unit, where the range tells it, too."""
    if capture.axis == "rotary" and modulus == _DEGREES:
        return mend(capture, "position_rad", {"scale": math.pi / 180, "wrap": 2 * math.pi})
    if capture.axis == "rotary" and whole:
        return mend(capture, "position_rad", {"wrap": modulus}, target="position_counts")
    return mend(capture, "position_rad", {"wrap": modulus})


def _turned_in_gaps(time_s: F64, position: F64) -> NDArray[np.bool_]:
    """Which steps the motion can have made in a pause of the recording, no faster than it is seen elsewhere."""
    h, step = np.diff(time_s), np.abs(np.diff(position))
    pause = h > GAP_FACTOR * sample_period(time_s)
    fastest = float(np.max(step[~pause] / h[~pause], initial=0.0))
    return np.asarray(pause & (step <= fastest * h))


def _jumps(position: F64, turned: NDArray[np.bool_]) -> F64:
    """Sizes of the jumps without the motion in them; empty where there is none that stays.

    Args:
        turned: steps that are motion, shape (n − 1,).
    """
    step = np.where(turned, 0.0, np.diff(position))
    size = np.abs(step)
    limit = min(_JUMP * float(np.ptp(np.cumsum(step))), _apart(size))
    at = np.flatnonzero(size > limit)
    rest = np.delete(step, at)
    if not at.size or not rest.size or 2 * float(np.max(np.abs(rest))) > limit:
        return np.empty(0)
    back = np.concatenate([step[1:], [0.0]])[at]
    before = np.concatenate([[0.0], step[:-1]])[at]
    undone = ((np.sign(back) != np.sign(step[at])) & (np.abs(back) > limit)) | (
        (np.sign(before) != np.sign(step[at])) & (np.abs(before) > limit)
    )
    if np.all(undone):  # a wrong sample goes there and comes back
        return np.empty(0)
    at = at[~undone]
    typical = np.where(np.abs(back[~undone]) > limit, 0.0, back[~undone])
    return np.asarray(np.abs(step[at] - typical))


def _apart(size: F64) -> float:
    """What lies between the few largest steps and all others, where these are that far apart; else infinite."""
    largest = np.sort(size)[::-1][: _FEW_JUMPS + 1]
    far = np.flatnonzero(largest[:-1] > _FAR * largest[1:])
    return float(largest[far[0]]) / 2 if far.size and largest[far[0] + 1] > 0.0 else np.inf


def _range_of(size: float, capture: Capture, position: F64) -> tuple[float, str]:
    """The counter's range and its words."""
    for turn, words in _TURNS:
        if abs(size / turn - 1.0) < _NEAR:
            return turn, f"it starts again after {words}"
    per_rev = capture.counts_per_rev
    unit = 1.0 if _whole(position) else 2 * math.pi / per_rev if per_rev else None
    if unit is not None:
        for bits in _BITS:
            if abs(size / (unit * 2.0**bits) - 1.0) < _NEAR:
                return unit * 2.0**bits, f"a counter of {bits} bits that is full and starts again"
    return size, "it starts again, or was set to zero (the range is read from the jump: put the exact one)"


def _resolution(position: F64) -> float:
    """The smallest step between neighbouring positions."""
    step = np.abs(np.diff(position))
    return float(np.min(step[step > 0.0], initial=np.inf))


def _whole(position: F64) -> bool:
    return bool(np.all(position == np.round(position)))
