"""What a simulated drive has to say: the samples behind every simulated wire."""

from __future__ import annotations

from typing import Protocol

from drivers.base import DriveInfo
from servo_daemon.samples import SampleBlock


class SampleSource(Protocol):
    """An endless stream of samples."""

    @property
    def info(self) -> DriveInfo:
        """Resolutions, counts per revolution and sample period of the simulated drive."""
        ...

    def next_block(self, n: int) -> SampleBlock:
        """The next n samples, in device time."""
        ...
