"""What a simulated drive has to say: the samples behind every simulated wire."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

from drivers.base import DriveInfo
from servo_daemon.samples import F64, SampleBlock

#: A host that stood still longer than this (suspended, stopped) continues from now instead of catching up, s.
MAX_BEHIND_S = 1.0


class SampleSource(Protocol):
    """An endless stream of samples."""

    @property
    def info(self) -> DriveInfo:
        """Resolutions, counts per revolution and sample period of the simulated drive."""
        ...

    def next_block(self, n: int) -> SampleBlock:
        """The next n samples, in device time."""
        ...


class CommandedSource(Protocol):
    """A motor that is given its voltages.

    Attributes:
        most_V: greatest voltage that its drive can apply.
    """

    @property
    def most_V(self) -> float: ...

    @property
    def info(self) -> DriveInfo: ...

    def commanded_block(self, voltage_V: F64) -> SampleBlock:
        """The next samples with these voltages, shape (n,), V."""
        ...


class Drive(SampleSource, CommandedSource, Protocol):
    """A drive that moves by itself, or as it is commanded."""


@dataclass(frozen=True, slots=True)
class Reversed:
    """A drive with a sensor that was wired the wrong way round.

    Attributes:
        channel: which has the other sign.
    """

    drive: Drive
    channel: Literal["current_A", "position_rad"]

    @property
    def info(self) -> DriveInfo:
        return self.drive.info

    @property
    def most_V(self) -> float:
        return self.drive.most_V

    def next_block(self, n: int) -> SampleBlock:
        return self._turned(self.drive.next_block(n))

    def commanded_block(self, voltage_V: F64) -> SampleBlock:
        return self._turned(self.drive.commanded_block(voltage_V))

    def _turned(self, block: SampleBlock) -> SampleBlock:
        values = getattr(block, self.channel)
        return replace(block, **{self.channel: -values}) if values is not None else block
