"""A snapshot of the last samples at the rate at which they came, as an oscilloscope takes one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64, SampleBlock, concatenate

Edge = Literal["rising", "falling"]

#: Samples of an answer: two seconds of a drive at 10 kHz, some megabytes of JSON. A longer snapshot is cut short.
MOST_SAMPLES: Final = 20_000
#: So far back a trigger is looked for, s: twice the longest snapshot.
LOOK_BACK_S: Final = 10.0
#: A signal must have been so much beyond the level, as a share of its range, before it crosses it (again): noise about
#: the level is no edge. Half a division of the usual eight, as the noise rejection of oscilloscopes.
HYSTERESIS: Final = 1 / 16


@dataclass(frozen=True, slots=True)
class Trigger:
    """`channel` crosses `level`, in its unit, `edge`-wise; `before` of the snapshot lies before it, as a share."""

    channel: str
    level: float
    edge: Edge
    before: float


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Samples from one block of time, and what was triggered on.

    Attributes:
        block: None: nothing was found.
        trigger_s: device time of the first sample beyond the level, s; None: there was none, or none was asked for.
        last_s: device time of the last sample there is, s: the next `since`.
        shortened: it holds less time than was asked for.
    """

    block: SampleBlock | None
    trigger_s: float | None
    last_s: float | None
    shortened: bool = False


def take(
    blocks: Sequence[SampleBlock], seconds: float, trigger: Trigger | None, since_s: float | None = None
) -> Snapshot:
    """The last `seconds`, or those about the last trigger of which all is there.

    Args:
        blocks: of one drive, oldest first, with the same channels.
        since_s: only triggers (or samples) after this device time, s.

    Raises:
        KeyError: no such channel.
    """
    if not blocks:
        return Snapshot(None, None, None)
    last_s = float(blocks[-1].time_s[-1])
    oldest = last_s - (seconds if trigger is None else LOOK_BACK_S)
    near = concatenate([b for b in blocks if float(b.time_s[-1]) >= oldest])
    if trigger is None:
        start = oldest if since_s is None else max(oldest, since_s)
        return _cut(near, start, last_s, None, last_s)
    if trigger.channel not in near.channels:
        raise KeyError(trigger.channel)
    times = near.time_s[edges(getattr(near, trigger.channel), trigger.level, trigger.edge)]
    after = seconds * (1.0 - trigger.before)
    whole = times[(times + after <= last_s) & (times > (-np.inf if since_s is None else since_s))]
    if not len(whole):
        return Snapshot(None, None, last_s)
    at = float(whole[-1])
    return _cut(near, at - seconds * trigger.before, at + after, at, last_s)


def edges(values: F64, level: float, edge: Edge) -> NDArray[np.int64]:
    """Indices of the first samples beyond the level, `values` of shape (n,) having been on the other side before."""
    values, level = (values, level) if edge == "rising" else (-values, -level)
    known = values[np.isfinite(values)]
    if not len(known):
        return np.empty(0, np.int64)
    low = level - HYSTERESIS * float(known.max() - known.min())
    side = np.where(values >= level, 1, np.where(values < low, -1, 0))
    told: NDArray[np.int64] = np.flatnonzero(side)
    begins: NDArray[np.bool_] = (side[told][1:] == 1) & (side[told][:-1] == -1)
    later: NDArray[np.int64] = told[1:]
    return later[begins]


def _cut(near: SampleBlock, start: float, end: float, trigger_s: float | None, last_s: float) -> Snapshot:
    first, stop = (int(k) for k in (np.searchsorted(near.time_s, start), np.searchsorted(near.time_s, end, "right")))
    if first >= stop:
        return Snapshot(None, trigger_s, last_s)
    shortened = stop - first > MOST_SAMPLES
    if shortened:  # up to the end, or around the trigger, which must be in it
        at = int(np.searchsorted(near.time_s, end if trigger_s is None else trigger_s))
        first = max(first, min(stop - MOST_SAMPLES, at - round(MOST_SAMPLES * (at - first) / (stop - first))))
        stop = first + MOST_SAMPLES
    return Snapshot(near.slice(first, stop), trigger_s, last_s, shortened)


def column(values: F64) -> list[float | None]:
    """Numbers as JSON can hold them, with the seven digits that a 24 bit converter has."""
    known = np.isfinite(values)
    largest = float(np.abs(values[known]).max()) if known.any() else 0.0
    decimals = 7 if largest == 0.0 else 6 - int(np.floor(np.log10(largest)))
    rounded = np.round(values, min(decimals, 300)).tolist()
    return [value if there else None for value, there in zip(rounded, known.tolist(), strict=True)]
