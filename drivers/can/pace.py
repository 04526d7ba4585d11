"""How far apart a message is sent, from when it was received: its times on a link that has none.

Stamps of an adapter that lets many frames go at once say nothing of the time between two of them. Where the sender
keeps a steady rate the stamps stay within a band around it, however wide; where it does not, they wander off, and only
stamps of single frames can be believed.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from drivers.base import DriveInfo
from drivers.can.decode import FrameBatch
from drivers.can.listener import BusListener, FrameDecoder
from drivers.can.vendor import VendorDecoder
from drivers.can.waiting import Waiting
from servo_daemon.numerics import median
from servo_daemon.samples import F64, SampleBlock

#: From fewer messages no period is estimated.
LEAST = 8
#: A configured period may differ by this share from the one heard: the accuracy of 1.5 s of stamps in bunches of 50 ms.
TOLD_WITHIN = 0.05
#: Frames come in bunches where more than this share of the steps is shorter than half a period.
_HALF, _BUNCHED = 0.5, 0.1
#: Stamps are used as they are where the steps, bunches left out, are off by less than this share of a period.
_CLEAN = 0.02
#: A line and its listener only delay stamps. So the earliest stamps of `_PARTS` parts of a steady sender lie on a line,
#: to within the share `_KEPT` of the spread of stamps `_NEAR_S` apart. Simulated, 4,800 sets of 1.5 s: at most 0.1 in
#: 95 % for periods up to 5 ms, with and without a listener that stalls; of senders with random waits at least 0.3,
#: unless bunches hide them. A spread below a tenth of a period (`_LITTLE`) does no harm.
_PARTS, _IN_A_PART, _NEAR_S, _KEPT, _LITTLE = 8, 16, 0.06, 0.3, 0.1


@dataclass(frozen=True, slots=True)
class Pace:
    """What stamps tell of their sender.

    Attributes:
        period_s: from message to message.
        steady: it sends at a constant rate.
        bunched: many frames were stamped at once.
        clean: stamps are used as they are.
    """

    period_s: float
    steady: bool
    bunched: bool
    clean: bool


def heard_pace(stamp_s: F64) -> Pace | None:
    """From receive times, increasing, shape (n,); None: all of one moment. Frames that waited for the listener
    do not bias the period; lost ones bias it by their share."""
    n = len(stamp_s)
    reach = max(1, n // 4)
    period_s = median((stamp_s[reach:] - stamp_s[:-reach]) / reach)
    if not period_s > 0.0:
        return None
    steps = np.diff(stamp_s)
    bunched = float(np.mean(steps < _HALF * period_s)) > _BUNCHED
    steady = _strays(stamp_s - period_s * np.arange(n)) < _KEPT * max(_spread(stamp_s, period_s), _LITTLE * period_s)
    clean = float(np.percentile(np.abs(steps - period_s), 100.0 * (1.0 - _BUNCHED))) < _CLEAN * period_s
    return Pace(period_s, steady, bunched, clean)


def _strays(late_s: F64) -> float:
    """How far the earliest stamps of the parts are from a line, rms, s. `late_s`: delay of each stamp, shape (n,)."""
    parts = np.array_split(late_s, min(max(len(late_s) // _IN_A_PART, 4), _PARTS))
    earliest, k = np.array([part.min() for part in parts]), np.arange(len(parts))
    away = earliest - np.polynomial.Polynomial.fit(k, earliest, 1)(k)
    return float(np.sqrt(np.sum(np.square(away)) / (len(parts) - 2)))


def _spread(stamp_s: F64, period_s: float) -> float:
    """Median deviation of the distance of stamps that are about `_NEAR_S` apart, s."""
    lag = min(max(1, round(_NEAR_S / period_s)), len(stamp_s) // 2)
    apart = stamp_s[lag:] - stamp_s[:-lag]
    return median(np.abs(apart - median(apart)))


class PacedDecoder:
    """A decoder that first measures how often the message that makes a sample comes. Frames wait meanwhile.

    Args:
        decoder: of the frames, `vendor` inside it.
        triggers: identifiers of the message that makes a sample.
        told_s: the period as the user gives it.
    """

    def __init__(
        self, decoder: FrameDecoder, vendor: VendorDecoder, triggers: frozenset[int], told_s: float | None
    ) -> None:
        self._decoder, self._vendor, self._triggers, self._told_s = decoder, vendor, triggers, told_s
        self._forget()

    def _forget(self) -> None:
        self.remark: str | None = None
        self.learnt: str | None = None
        self._waiting = Waiting() if self._vendor.dates_by_stamps else None

    @property
    def keys(self) -> frozenset[int]:
        return self._decoder.keys

    @property
    def info(self) -> DriveInfo:
        return self._decoder.info

    def reset(self) -> None:
        """Forget everything: the next frames may be another device's."""
        self._decoder.reset()
        self._forget()

    def feed(self, batch: FrameBatch) -> list[SampleBlock]:
        """Samples of these frames, none until it is known how far apart they are."""
        if self._waiting is None:
            blocks = self._decoder.feed(batch)
            if self._vendor.off_pace:
                self._decoder.reset()
                self._forget()
                self._vendor.begin_anew()
            return blocks
        if not self._waiting.take(batch) or not self._look(self._waiting.batches):
            return []
        waiting, self._waiting = self._waiting.batches, None
        return [block for batch in waiting for block in self._decoder.feed(batch)]

    def _look(self, waiting: Collection[FrameBatch]) -> bool:
        """Whether the period of the samples is known by now; sets `remark` or `learnt`."""
        keys = np.concatenate([b.keys for b in waiting])
        stamp_s = np.concatenate([b.stamp_s for b in waiting])[np.isin(keys, list(self._triggers))]
        pace = heard_pace(stamp_s) if len(stamp_s) >= LEAST else None
        if pace is None:
            return False
        self.remark = why_not(self._vendor.trigger.name, pace, self._told_s)
        if self.remark is None and self._told_s is None:
            self.learnt = take(self._vendor, pace)
        return self.remark is None


def why_not(name: str, pace: Pace, told_s: float | None) -> str | None:
    """In words, why samples of the message `name` cannot be dated; None: they can."""
    if told_s is not None and abs(pace.period_s / told_s - 1.0) > TOLD_WITHIN:
        return (
            f"message {name} comes every {_ms(pace.period_s)}, not every {_ms(told_s)}: correct the option period_s, "
            "or leave it out"
        )
    if told_s is None and pace.bunched and not pace.steady:
        return (
            f"message {name} comes in bunches and at no steady rate ({_ms(pace.period_s)} on average): when it was "
            "sent is not known. Have the drive send it at a fixed rate, or use an adapter that stamps frames"
        )
    return None


def take(vendor: VendorDecoder, pace: Pace) -> str:
    """Have samples dated by this pace; returns what to tell the user."""
    name, ms = vendor.trigger.name, _ms(pace.period_s)
    vendor.take_pace(pace.period_s if pace.steady else None, even=not pace.clean)
    if not pace.steady:
        return f"message {name} comes at no steady rate ({ms} on average): its times are those of the stamps"
    how, dated = " in bunches" if pace.bunched else "", "of the stamps" if pace.clean else "even"
    return f"message {name} comes every {ms}{how}, as heard: its times are {dated}"


def _ms(period_s: float) -> str:
    return f"{1e3 * period_s:.3g} ms"


class PacedListener(BusListener):
    """A drive that is listened to with a `PacedDecoder`, or, where it sends its times by itself, without."""

    _paced: PacedDecoder | None = None

    def _pace(
        self, decoder: FrameDecoder, vendor: VendorDecoder, triggers: frozenset[int], told_s: float | None
    ) -> None:
        """Read with this decoder; see `PacedDecoder`."""
        self._paced = PacedDecoder(decoder, vendor, triggers, told_s)

    @property
    def _frames(self) -> FrameDecoder:
        assert self._paced is not None
        return self._paced

    @property
    def remark(self) -> str | None:
        return None if self._paced is None else self._paced.remark

    @property
    def learnt(self) -> str | None:
        return None if self._paced is None else self._paced.learnt
