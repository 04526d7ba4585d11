"""What is kept for each drive between two requests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from servo_daemon.published.view import DaemonView, DriveView

T = TypeVar("T")


class PerDrive(Generic[T]):
    """Made at the first request for a drive, and anew where another drive has its name since; that of drives that have
    gone is let go. Used by the event loop only."""

    def __init__(self, daemon: DaemonView, make: Callable[[DriveView], T]) -> None:
        self._daemon, self._make = daemon, make
        self._kept: dict[str, tuple[DriveView, T]] = {}

    def of(self, drive: DriveView) -> T:
        """What is kept for this drive; made where there is nothing yet."""
        kept = self._kept.get(drive.name)
        if kept is None or kept[0] is not drive:
            there = self._daemon.drives
            self._kept = {name: one for name, one in self._kept.items() if there.get(name) is one[0]}
            kept = self._kept[drive.name] = (drive, self._make(drive))
        return kept[1]
