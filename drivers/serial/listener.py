"""A serial port that is listened to: pyserial for the port, a decoder for the bytes. Nothing is sent but by
`commander`, for commissioning.

Every wakeup takes all bytes the system has in one read, and wakeups are kept `_MIN_READ_SPACING_S` apart, so the cost
is that of some wakeups a second, whatever the baud rate and however thinly the bytes trickle in.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from typing import Any, Protocol

import serial

from drivers.base import Driver, disconnected
from drivers.serial.port import READ_SIZE, open_port
from servo_daemon.errors import DriverDisconnectedError
from servo_daemon.samples import SampleBlock

#: A wakeup costs the same for one frame as for ten, and a UART without buffer would wake for every few bytes. 40 ms
#: keep a drive at 1 kHz at 25 wakeups a second and leave a third of the 60 ms from sample to API.
_MIN_READ_SPACING_S = 0.04


class StreamDecoder(Protocol):
    """What turns the bytes of a line into samples."""

    @property
    def has_ready(self) -> bool:
        """Whether a block waits that `feed(b"")` returns."""

    def reattach(self) -> None:
        """The line was opened anew."""

    def feed(self, data: bytes, host_time_s: float = 0.0) -> SampleBlock | None:
        """Take bytes as they arrived; the samples that they complete, or None."""


class SerialListener(Driver):
    """A driver that listens to a serial port.

    Args:
        port, baudrate: of the line.
        keep: what has arrived before the opening is given to `_hear` instead of being thrown away.
    """

    _spacing_s = _MIN_READ_SPACING_S

    def __init__(self, name: str, options: dict[str, Any], *, port: str, baudrate: int, keep: bool) -> None:
        super().__init__(name, options)
        self._where, self._baudrate, self._keep = port, baudrate, keep
        self._port: serial.Serial | None = None
        self._wake_r, self._wake_w = -1, -1
        self._io = threading.Lock()  # held by whoever uses the port: `close` waits for `read` to leave it
        self._last_read_s = 0.0

    @property
    def is_buffered(self) -> bool:
        return True

    @property
    def _stream(self) -> StreamDecoder:
        """The decoder of what arrives."""
        raise NotImplementedError

    def _hear(self, data: bytes) -> None:
        """What had arrived before the port was opened; only with `keep`."""

    def _open(self) -> None:
        self._port = open_port(self.name, self._where, self._baudrate, keep=self._keep)
        self._wake_r, self._wake_w = os.pipe()
        self._stream.reattach()
        if self._keep:
            with contextlib.suppress(OSError):  # gone already: `read` will say so
                self._hear(bytes(self._port.read(READ_SIZE)))

    def _read(self, timeout_s: float) -> SampleBlock | None:
        if self._stream.has_ready:
            return self._stream.feed(b"", time.monotonic())
        deadline = time.monotonic() + max(timeout_s, 0.0)
        while self.is_open:
            with self._io:
                data = self._read_at_once() if timeout_s <= 0.0 else None
                data = data or self._wait_and_read(deadline)
            if data is None:
                return None
            block = self._stream.feed(data, self._last_read_s)
            if block is not None:
                return block
        return None

    def _read_at_once(self) -> bytes | None:
        """What has arrived, by one call of the system instead of three: whoever reads many ports in turn gives up the
        interpreter with each. Nothing: there is nothing, or the port is gone, which only waiting tells."""
        port = self._port
        if port is None or not self._is_open:
            return None
        try:
            data = os.read(port.fileno(), READ_SIZE)
        except BlockingIOError:
            return None
        except OSError as error:
            raise self._gone(error) from error
        if data:
            self._last_read_s = time.monotonic()
        return data

    def _wait_and_read(self, deadline: float) -> bytes | None:
        """Everything that has arrived, as soon as there is something; None at the deadline or on `close`."""
        port = self._port
        if port is None or not self._is_open:
            return None
        try:
            pause = min(self._last_read_s + self._spacing_s, deadline) - time.monotonic()
            if pause > 0 and select.select([self._wake_r], [], [], pause)[0]:
                return None
            wait = max(deadline - time.monotonic(), 0.0)
            ready = select.select([port.fileno(), self._wake_r], [], [], wait)[0]
            if not ready or self._wake_r in ready:
                return None
            data = bytes(port.read(READ_SIZE))  # timeout 0: one read of the system, no waiting
        except OSError as error:  # SerialException is one: hang-up, EIO, a read of nothing
            raise self._gone(error) from error
        self._last_read_s = time.monotonic()
        return data

    def _send(self, data: bytes) -> None:
        """All of it, at once.

        Raises:
            DriverDisconnectedError: the port is gone, or takes no more.
        """
        with self._io:
            if self._port is None:
                raise disconnected(self.name, f"{self._where}: closed")
            try:
                sent = os.write(self._port.fileno(), data)
            except OSError as error:
                raise self._gone(error) from error
        if sent < len(data):
            raise disconnected(self.name, f"{self._where}: it takes no more bytes")

    def _gone(self, error: OSError) -> DriverDisconnectedError:
        return disconnected(self.name, f"{self._where}: {error}")

    def _close(self) -> None:
        wake_w, self._wake_w = self._wake_w, -1
        if wake_w < 0:
            return
        os.write(wake_w, b"x")  # frees a reader from its wait
        with self._io:
            port, self._port = self._port, None
            if port is not None:
                with contextlib.suppress(OSError):  # the device may be gone: then there is nothing left to release
                    port.close()
            os.close(wake_w)
            os.close(self._wake_r)
            self._wake_r = -1
