"""A moteus' telemetry over its diagnostic channel: text commands in, text and binary out, through subframes.

    40 channel length data      to the drive          `tel schema NAME`, `tel get NAME`: both read, and change nothing
    42 channel length           what it has to say?
    41 channel length data      from the drive        `schema NAME` or `emit NAME`, CR LF, size (4), as many bytes

A schema tells how the values of NAME are laid out: types, with names, in the order of the bytes (moteus 1.1.1,
`reader.py`). Only layouts of fixed size are read.
"""

from __future__ import annotations

import struct

from servo_daemon.errors import WireError

#: Subframes of the tunnelled stream: from the host, from the drive, a poll; and the channel of the diagnostic one.
CLIENT_DATA, SERVER_DATA, POLL = 0x40, 0x41, 0x42
CHANNEL = 1
#: Of a CAN FD frame's 64 bytes three are the subframe's head.
MOST = 61

_FIXED_SIZES = {1: 0, 2: 1, 7: 4, 8: 8, 22: 8, 23: 8}  # null, bool, float, double, time stamp, duration
_FINAL, _INT, _UINT, _FLOAT, _OBJECT, _ENUM, _FIXED_ARRAY = 0, 3, 4, 7, 16, 17, 19
#: Deeper than any of the drive's.
_DEEPEST = 8


def write(text: str) -> bytes:
    """The subframe that says a line to the drive."""
    line = text.encode("ascii") + b"\n"
    return bytes([CLIENT_DATA, CHANNEL, len(line)]) + line


def poll() -> bytes:
    """The subframe that asks for what the drive has to say."""
    return bytes([POLL, CHANNEL, MOST])


def said(data: bytes) -> bytes | None:
    """What the drive says in a frame; None: the frame is no answer to `poll`."""
    if len(data) < 3 or data[0] != SERVER_DATA or data[1] != CHANNEL or data[2] > len(data) - 3:
        return None
    return data[3 : 3 + data[2]]


def announced(text: bytes, what: str) -> bytes | None:
    """The bytes behind an announcement such as "emit servo_control"; None: not all of them are there yet."""
    head = what.encode("ascii") + b"\r\n"
    at = text.find(head)
    begin = at + len(head) + 4
    if at < 0 or len(text) < begin:
        return None
    (size,) = struct.unpack_from("<I", text, begin - 4)
    return text[begin : begin + size] if len(text) >= begin + size else None


def place_of(schema: bytes, name: str) -> int:
    """Where a float of this name begins in the values that a schema describes.

    Raises:
        WireError: there is none, what stands before it has no fixed size, or this is no schema.
    """
    reader = _Reader(schema)
    if reader.number() != _OBJECT:
        raise WireError("the drive's schema is no object")
    reader.number()
    at = 0
    while True:
        field, kind = reader.field()
        if kind == _FINAL:
            raise WireError(f"the drive's schema has no {name}")
        if field == name:
            if kind != _FLOAT:
                raise WireError(f"the drive's {name} is no float")
            return at
        at += reader.rest_of(kind)


class _Reader:
    """Of the bytes of a schema."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, n: int) -> bytes:
        if self._at + n > len(self._data):
            raise WireError("the drive's schema is cut off")
        self._at += n
        return self._data[self._at - n : self._at]

    def number(self) -> int:
        """Seven bits a byte, the lowest first; bit 7: more follow."""
        value = 0
        for shift in range(0, 35, 7):
            byte = self.take(1)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise WireError("a number in the drive's schema is too long")

    def text(self) -> str:
        return self.take(self.number()).decode("utf-8", "replace")

    def field(self) -> tuple[str, int]:
        """Name and type of the next field; `rest_of` goes on from there."""
        self.number()
        name = self.text()
        for _ in range(self.number()):
            self.text()
        return name, self.number()

    def rest_of(self, kind: int) -> int:
        """To the end of a field of this type; the bytes that its value takes."""
        size = self.size(kind)
        if self.take(1)[0]:
            self.take(size)  # its value where none is sent
        return size

    def size(self, kind: int, depth: int = 0) -> int:
        """Bytes of a value of this type, the rest of whose description comes next."""
        if depth > _DEEPEST:
            raise WireError("the drive's schema is too deep")
        if kind in _FIXED_SIZES:
            return _FIXED_SIZES[kind]
        if kind in (_INT, _UINT):
            return self.take(1)[0]
        if kind == _ENUM:
            size = self.size(self.number(), depth + 1)
            for _ in range(self.number()):
                self.take(size)
                self.text()
            return size
        if kind == _FIXED_ARRAY:
            count = self.number()
            return count * self.size(self.number(), depth + 1)
        if kind == _OBJECT:
            self.number()
            total = 0
            while True:
                _, inner = self.field()
                if inner == _FINAL:
                    self.take(1)
                    return total
                size = self.size(inner, depth + 1)
                if self.take(1)[0]:
                    self.take(size)
                total += size
        raise WireError(f"the drive's schema has a value of no fixed size (type {kind})")
