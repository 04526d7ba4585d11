"""What a simulated drive has to say: the samples behind every simulated wire."""

from __future__ import annotations

from typing import Protocol

from drivers.base import DriveInfo
from servo_daemon.samples import F64, SampleBlock


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
