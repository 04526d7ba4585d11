"""What a poller asks over: bytes out, bytes in, and a way to end a wait."""

from __future__ import annotations

import contextlib
import os
import select
from typing import Protocol

import serial

from drivers.serial.port import READ_SIZE


class Link(Protocol):
    """An open line to a drive. `OSError` from `send` or `receive` means that it is gone."""

    def send(self, data: bytes) -> None:
        """Put one request on the line."""
        ...

    def receive(self, timeout_s: float) -> bytes:
        """What has arrived, as soon as there is something; nothing at the end of the time, or on `wake`."""
        ...

    def pause(self, seconds: float) -> bool:
        """Wait whatever arrives; ended by `wake`, and then true."""
        ...

    def wake(self) -> None:
        """End a wait of `receive` or `pause` that another thread is in, and every later one."""
        ...

    def close(self) -> None:
        """Release it. Never raises."""
        ...


class SerialLink:
    """A serial port whose reads never wait, as `drivers.serial.port.open_port` opens it."""

    def __init__(self, port: serial.Serial) -> None:
        self._port = port
        self._port.write_timeout = 1.0  # a request is a few bytes: a line that takes none of them for so long is dead
        self._fd = port.fileno()
        self._wake_r, self._wake_w = os.pipe()
        self._watched = (self._fd, self._wake_r)

    def send(self, data: bytes) -> None:
        try:
            sent = os.write(self._fd, data)  # pyserial's own waits before and after
        except BlockingIOError:
            sent = 0
        if sent < len(data):
            self._port.write(data[sent:])

    def receive(self, timeout_s: float) -> bytes:
        if timeout_s <= 0.0 and (data := self._read()):  # one call of the system instead of two
            return data
        ready = select.select(self._watched, (), (), timeout_s if timeout_s > 0.0 else 0.0)[0]
        if not ready or self._wake_r in ready:
            return b""
        data = self._read()
        if data == b"":
            raise OSError("the port reports that something has come, and has nothing")
        return data or b""

    def _read(self) -> bytes | None:
        """What is there; nothing where the line is silent or gone; None: another program has taken it."""
        try:
            return os.read(self._fd, READ_SIZE)
        except BlockingIOError:
            return None

    def pause(self, seconds: float) -> bool:
        return bool(select.select((self._wake_r,), (), (), max(0.0, seconds))[0])

    def wake(self) -> None:
        os.write(self._wake_w, b"x")

    def close(self) -> None:
        with contextlib.suppress(OSError):  # the device may be gone: then there is nothing left to release
            self._port.close()
        os.close(self._wake_r)
        os.close(self._wake_w)
