"""What python-can's slcan interface needs to keep up and to survive line noise: a read-ahead before its serial port.

python-can (4.6) reads an slcan adapter byte by byte, each byte a select and a read of its own: a seventh of a core at
1,000 frames/s (`benchmarks/wire_can.py`). It also keeps a line with a byte outside ASCII in its buffer and fails to
decode it again on every later read, so that one disturbed byte ends reception for good, and gathers a line that does
not end for ever. `ReadAhead` stands in for the
serial port: it reads whatever has arrived at once and hands it out from memory, with bytes that cannot be slcan
replaced by '?', which python-can then refuses as one bad line.
"""

from __future__ import annotations

import os
from typing import Any

#: The longest line has 140 bytes (64 of CAN FD, two digits each); python-can would gather one without an end for ever.
_MAX_LINE = 256
#: Bytes 0x80..0xFF never occur in slcan.
_ASCII_ONLY = bytes(range(128)) + b"?" * 128


def is_taken(port: str) -> bool:
    """Whether another program has locked a serial port, as pyserial does: two would take each other's frames away, and
    python-can writes to it before it can be asked. False where that cannot be told."""
    if os.name != "posix":
        return False
    import fcntl

    try:
        descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


class ReadAhead:
    """A pyserial port that reads in blocks. Everything but reading goes to the port itself.

    Args:
        port: an open port with timeout 0, so that reads return at once.
    """

    def __init__(self, port: Any) -> None:
        self._port = port
        self._bytes = b""
        self._next = 0
        self._open = 0  # bytes since the last end of a line

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read without waiting: those in memory, else those in the port."""
        return len(self._bytes) - self._next or int(self._port.in_waiting)

    @property
    def buffered(self) -> bool:
        """Whether bytes are in memory, which no select on the port will tell of."""
        return self._next < len(self._bytes)

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes, none if none have arrived.

        Raises:
            OSError: the port is gone (serial.SerialException is one).
        """
        if self._next >= len(self._bytes):
            arrived: bytes = self._port.read(max(1, self._port.in_waiting))
            self._bytes, self._next = self._ended(arrived.translate(_ASCII_ONLY)), 0
        start = self._next
        self._next = min(start + size, len(self._bytes))
        return self._bytes[start : self._next]

    def _ended(self, arrived: bytes) -> bytes:
        """The same; in place of what makes a line too long, its end."""
        end = max(arrived.rfind(b"\r"), arrived.rfind(b"\a"))
        self._open = self._open + len(arrived) if end < 0 else len(arrived) - end - 1
        if self._open <= _MAX_LINE:
            return arrived
        self._open = 0
        return arrived[: end + 1] + b"?\r"

    def reset_input_buffer(self) -> None:
        """Forget what has arrived."""
        self._bytes, self._next = b"", 0
        self._port.reset_input_buffer()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)
