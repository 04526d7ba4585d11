"""A maker's drive that tells nothing of itself: its frames are listened to first, then read.

Which messages come, how often, and which of them ends a burst, is heard in the first seconds. What the maker's frames
then mean is decided by a function of what was heard, and the frames go to a `VendorDecoder`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field

import numpy as np

from drivers.base import DriveInfo, DriverCounters
from drivers.can.decode import Field, FrameBatch
from drivers.can.formula import parse_formula
from drivers.can.listener import BusListener, FrameDecoder
from drivers.can.map import MappedChannel, Operand
from drivers.can.vendor import VendorDecoder
from drivers.can.waiting import Waiting
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import F64, U8, SampleBlock

#: A message that comes at nine tenths of the fastest rate comes with every burst.
_EVERY_BURST = 0.9
#: Gaps after two messages that differ by less than this share of a period do not tell which is the last.
_DECISIVE = 0.1


@dataclass(frozen=True, slots=True)
class Heard:
    """Frames of one identifier: shape (n,) receive times, s, and shape (n, 8) bytes; n >= 2."""

    stamp_s: F64
    data: U8
    gap_s: float  # mean time to the next frame of the drive

    @property
    def period_s(self) -> float:
        """Mean time from one to the next."""
        return float(self.stamp_s[-1] - self.stamp_s[0]) / (len(self.stamp_s) - 1)


@dataclass(frozen=True, slots=True)
class Choice:
    """What was decided: a decoder, or in words why there is none (yet), or what is missing; and which drive it is."""

    decoder: VendorDecoder | None = None
    remark: str | None = None
    identity: str | None = None


def heard_in(batches: Collection[FrameBatch]) -> dict[int, Heard]:
    """By identifier, what came at least three times."""
    keys = np.concatenate([b.keys for b in batches])
    stamp_s = np.concatenate([b.stamp_s for b in batches])
    data = np.concatenate([b.data[:, :8] for b in batches])
    after = np.diff(stamp_s, append=stamp_s[-1])
    found = {}
    for key in np.unique(keys).tolist():
        mine = keys == key
        if np.count_nonzero(mine) >= 3 and stamp_s[mine][-1] > stamp_s[mine][0]:
            found[key] = Heard(stamp_s[mine], data[mine], float(after[mine].mean()))
    return found


def in_every_burst(heard: dict[int, Heard], wanted: list[int]) -> list[int]:
    """Those of the wanted identifiers that come at the fastest rate among them, in the given order."""
    there = [key for key in wanted if key in heard]
    if not there:
        return []
    fastest = max(len(heard[key].stamp_s) for key in there)
    return [key for key in there if len(heard[key].stamp_s) >= _EVERY_BURST * fastest]


def last_of_burst(heard: dict[int, Heard], burst: list[int]) -> int:
    """The identifier after which the longest silence follows; where that is not clear, the last in the given order."""
    ranked = sorted(burst, key=lambda key: heard[key].gap_s)
    if len(ranked) > 1:
        lead = heard[ranked[-1]].gap_s - heard[ranked[-2]].gap_s
        if lead < _DECISIVE * heard[ranked[-1]].period_s:
            return burst[-1]
    return ranked[-1]


def channel(name: str, formula: str, wrap: float | None = None, **fields: Field | Operand) -> MappedChannel:
    """A channel as a formula of fields, written as in a signal map."""
    operands = tuple(
        f if isinstance(f, Operand) else Operand(operand, f, 1.0, 0.0, None) for operand, f in fields.items()
    )
    return MappedChannel(name, operands, parse_formula(formula, name), wrap)


def bits_of(
    key: int, name: str, first_bit: int, length: int, *, big_endian: bool, is_float: bool = False, scale: float = 1.0
) -> Field:
    """A signed whole-byte field of an 8-byte message; bits are counted from the first byte on."""
    shift = 64 - first_bit - length if big_endian else first_bit
    return Field(key, name, 8, 0, shift, length, big_endian, True, is_float, scale, 0.0)


@dataclass(slots=True)
class LearningDecoder:
    """Listens, decides, then decodes.

    Args:
        keys: identifiers that may be the drive's.
        choose: what to make of what was heard; asked again every `waiting.LEARN_S` until it gives a decoder.
        counters: counted up while nothing is decided: `frames_before_decision`.
        identity: of a drive of which nothing was heard yet.
    """

    keys: frozenset[int]
    choose: Callable[[dict[int, Heard]], Choice]
    counters: DriverCounters
    identity: str
    remark: str | None = None
    _decoder: VendorDecoder | None = field(default=None, init=False)
    _waiting: Waiting = field(default_factory=Waiting, init=False)
    _anew: bool = field(default=False, init=False)

    @property
    def undecided(self) -> bool:
        """Whether it is not known yet what frames mean."""
        return self._decoder is None

    @property
    def info(self) -> DriveInfo:
        if self._decoder is None:
            return DriveInfo(self.identity)
        told = self._decoder.info
        return DriveInfo(self.identity, told.sample_period_s, channels=told.channels)

    def reset(self) -> None:
        """Forget everything: the next frames may be another device's."""
        self._decoder, self._waiting, self.remark = None, Waiting(), None

    def feed(self, batch: FrameBatch) -> list[SampleBlock]:
        """Samples of these frames, none until it is decided what they mean."""
        if self._decoder is not None:
            blocks = self._decoder.feed(batch)
            if self._decoder.off_pace:  # its rate was changed
                self.reset()
                self._anew = True
            return blocks
        extra = self.counters.extra
        extra["frames_before_decision"] = extra.get("frames_before_decision", 0) + len(batch)
        if self._waiting.take(batch):
            choice = self.choose(heard_in(self._waiting.batches))
            self._decoder, self.remark = choice.decoder, choice.remark
            self.identity = choice.identity or self.identity
            if self._decoder is not None:
                self._waiting = Waiting()
                if self._anew:
                    self._decoder.begin_anew()
                self._anew = False
        return []


class LearningListener(BusListener):
    """A drive that is listened to with a `LearningDecoder`, which `_learn` makes at the end of the constructor."""

    def _learn(self, keys: frozenset[int], choose: Callable[[dict[int, Heard]], Choice]) -> None:
        """Begin with these identifiers; see `LearningDecoder`."""
        self._bus_name = f"{self._settings['interface']}:{self._settings.get('channel')}"
        self._decoder = LearningDecoder(keys, choose, self.counters, f"{self.kind}:{self._bus_name}")

    @property
    def remark(self) -> str | None:
        return self._decoder.remark

    @property
    def silence(self) -> str:
        return self._decoder.remark if self._decoder.undecided and self._decoder.remark else self._nothing_comes

    @property
    def _frames(self) -> FrameDecoder:
        return self._decoder

    def _whole(self, key: str, least: int, most: int) -> int | None:
        """An option that is a whole number; None: it is not given.

        Raises:
            DriverConfigError: it is another thing.
        """
        value = self.options.get(key)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most):
            raise DriverConfigError(f"{self._where}: {key} must be a whole number {least} .. {most}, not {value!r}")
        return value
