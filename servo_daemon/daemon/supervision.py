"""What systemd is told of the drives: that they are there, that they turn, how they are."""

from __future__ import annotations

import time
from collections.abc import Sequence

from servo_daemon.daemon.notify import Notifier
from servo_daemon.daemon.slot import DriveSlot

#: READY is told after the first fresh samples, or this long after the start, s.
START_TIMEOUT_S = 10.0


class Supervision:
    """Tells the service manager what it wants to know. All but `reloading` and `reloaded` belongs to one thread.

    Args:
        began: when the daemon started, host monotonic, s.
    """

    def __init__(self, notifier: Notifier, began: float) -> None:
        self._notifier, self._began = notifier, began
        self._ready, self._said, self._told = False, "", began

    def look(self, slots: Sequence[DriveSlot]) -> None:
        """Tell what there is to tell now."""
        now, fresh = time.monotonic(), any(slot.has_worked for slot in slots)
        if not self._ready and (fresh or now - self._began > START_TIMEOUT_S):
            self._ready = True
            self._notifier.ready(_summary(slots))
        if now - self._told < min(1.0, self._notifier.watchdog_interval_s or 1.0):
            return
        if all(slot.has_turned_since(self._told) for slot in slots):  # one that is overloaded turns
            self._told = now
            self._notifier.watchdog()
        if (summary := _summary(slots)) != self._said:
            self._said = summary
            self._notifier.status(summary)

    def reloading(self) -> None:
        """The configuration is being read again; `reloaded` must follow."""
        if self._ready:
            self._notifier.reloading()

    def reloaded(self, slots: Sequence[DriveSlot]) -> None:
        """A reload of the configuration is over."""
        if self._ready:
            self._notifier.ready(_summary(slots))


def _summary(slots: Sequence[DriveSlot]) -> str:
    """One line for `systemctl status`."""
    parts = []
    for runtime in (slot.runtime for slot in slots):
        snapshot = runtime.snapshot()
        parameters = snapshot.estimate.parameters if snapshot.estimate is not None else ()
        tracking = sum(p.status == "tracking" for p in parameters)
        parts.append(f"{runtime.name} {snapshot.connection}, {tracking} of {len(parameters)} parameters tracking")
    return "; ".join(parts)
