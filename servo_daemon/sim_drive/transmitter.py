"""The device's end of a pseudo-terminal, used as a UART is."""

from __future__ import annotations

import contextlib
import os
import select

#: What a UART's receive buffer of a small device holds.
_HEARD_SIZE = 4096


class Transmitter:
    """The master side of a pseudo-terminal, used like a UART's transmitter."""

    def __init__(self, master: int) -> None:
        self._master = master
        self._heard = b""
        self._poll = select.poll()
        self._poll.register(master, select.POLLIN | select.POLLHUP)
        self._poll_write = select.poll()
        self._poll_write.register(master, select.POLLOUT)

    def has_reader(self) -> bool:
        """Whether somebody has the port open. What they send is kept for `take_heard`, as much as a buffer holds."""
        events = dict(self._poll.poll(0)).get(self._master, 0)
        if events & select.POLLIN:
            with contextlib.suppress(OSError):
                self._heard = (self._heard + os.read(self._master, 65536))[-_HEARD_SIZE:]
        return not events & select.POLLHUP

    def take_heard(self) -> bytes:
        """What has been sent to the device since the last call."""
        heard, self._heard = self._heard, b""
        return heard

    def wait_for_bytes(self, timeout_s: float) -> None:
        """Wait until something has been sent to the device, or the reader left, or the timeout."""
        self._poll.poll(timeout_s * 1e3)

    def write(self, data: bytes) -> int:
        """Send what there is room for; how many bytes that was."""
        try:
            return os.write(self._master, data)
        except OSError:  # EAGAIN: no room; EIO: the reader left just now
            return 0

    def wait_for_room(self, timeout_s: float) -> None:
        """Wait until there is room, or the reader left, or the timeout."""
        self._poll_write.poll(timeout_s * 1e3)
