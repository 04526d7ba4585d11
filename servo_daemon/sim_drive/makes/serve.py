"""A device behind a pseudo-terminal: it answers what the host sends, and sends by itself what is due."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from servo_daemon.sim_drive.pty_link import POLL_S, PtyLink
from servo_daemon.sim_drive.source import MAX_BEHIND_S

#: A device that has nothing to read waits so long for a reader.
_ABSENT_S = 0.01


class Device(Protocol):
    """A device on a line.

    Attributes:
        period_s: how often `due` is asked; None: it sends nothing by itself.
    """

    period_s: float | None

    def receive(self, data: bytes) -> bytes:
        """The answers to what the host sent, in any portions."""
        ...

    def due(self) -> bytes:
        """What goes out by itself now, one period after the last time."""
        ...


def serve(link: Path, device: Device, *, stop: threading.Event, heard: Callable[[bytes], None] | None = None) -> None:
    """Serve `device` at `link` until `stop` is set. What a slow reader leaves no room for is lost.

    Args:
        heard: told everything that the host sends.

    Raises:
        BadInputError: the link cannot be made.
    """
    with PtyLink(link, hold_open=False) as pty:
        poll = select.poll()
        poll.register(pty.master, select.POLLIN | select.POLLHUP)
        next_s = time.monotonic()
        while not stop.is_set():
            period_s = device.period_s
            wait_s = POLL_S if period_s is None else min(POLL_S, max(0.0, next_s - time.monotonic()))
            events = dict(poll.poll(1e3 * wait_s)).get(pty.master, 0)
            present = not events & select.POLLHUP
            if events & select.POLLIN:
                with contextlib.suppress(OSError):
                    data = os.read(pty.master, 65536)
                    if heard is not None:
                        heard(data)
                    _write(pty.master, device.receive(data))
            elif not present:
                stop.wait(_ABSENT_S)
            now_s = time.monotonic()
            if period_s is not None and now_s >= next_s:
                next_s = max(next_s + period_s, now_s - MAX_BEHIND_S)
                line = device.due()
                if present:
                    _write(pty.master, line)


def _write(master: int, data: bytes) -> None:
    if data:
        with contextlib.suppress(OSError):  # no room, or the reader left just now
            os.write(master, data)
