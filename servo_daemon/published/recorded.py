"""What the API may see of the captures that the daemon keeps: recordings of the samples around an event."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


@dataclass(frozen=True, slots=True)
class KeptCapture:
    """One file.

    Attributes:
        id: unique among a drive's; letters, digits and "-".
        kind: of the event that it was kept for; "request" where somebody has asked for it.
        start, end: UTC, seconds since the epoch: from its first sample to its last, or to the event if that was noticed
            later.
        size: bytes.
    """

    id: str
    drive: str
    kind: str
    start: float
    end: float
    size: int
    path: Path


class Captures(Protocol):
    """All drives'. Any thread; nothing here waits for a disk."""

    def of(self, drive: str) -> Sequence[KeptCapture]:
        """Those of that drive, oldest first."""

    def request(self, drive: str, seconds: float) -> Future[KeptCapture]:
        """Have the last samples of that drive written; done when the file is there, with a ServoDaemonError if it came
        to nothing.

        Args:
            seconds: at most so much of device time.

        Raises:
            BusyError: too few samples are there, or too much is being written.
            RefusedError: the configuration does not allow it.
        """
