"""The text of an fdcanusb adapter: one line a frame (mjbots/fdcanusb, README).

host     can send <id hex> <data hex> b        b: with the faster rate for the data
adapter  OK                                    or ERR and a reason
adapter  rcv <id hex> <data hex> <flags…>

On a UART a moteus speaks the same, with ` *XX` at the end of a line: a checksum of all before the asterisk.
"""

from __future__ import annotations

import re

#: `rcv`, an identifier of 29 bits, at most 64 bytes, flags.
_RECEIVED = re.compile(rb"rcv ([0-9a-fA-F]{1,8}) ((?:[0-9a-fA-F]{2}){0,64})((?: [A-Za-z0-9.]{1,16})*)\s*")
#: A longer run without a line end is garbage.
_MOST_LINE = 256


def sent(frame_id: int, data: bytes) -> bytes:
    """The line that puts a frame on the bus."""
    return b"can send %04x %s b\n" % (frame_id, data.hex().encode())


def checksum(text: bytes) -> int:
    """CRC-8 with the polynomial 0x97, most significant bit first (moteus, `fdcanusb_device.py`)."""
    crc = 0
    for byte in text:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x97 if crc & 0x80 else crc << 1) & 0xFF
    return crc


def unchecked(line: bytes) -> bytes | None:
    """A line without its checksum, if it has one; None: that is wrong."""
    text, asterisk, digits = line.rstrip().rpartition(b"*")
    if not asterisk or len(digits) != 2:
        return line
    return text if digits.upper() == b"%02X" % checksum(text) else None


class Lines:
    """What the adapter says, as frames.

    Attributes:
        errors: lines that are nothing it can say, and `ERR`.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._carry = b""

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """The frames (identifier, data) that these bytes complete."""
        *lines, self._carry = (self._carry + data).split(b"\n")
        if len(self._carry) > _MOST_LINE:
            self._carry = b""
            self.errors += 1
        frames = []
        for text in map(unchecked, lines):
            match = None if text is None else _RECEIVED.fullmatch(text)
            if match is not None:
                frames.append((int(match[1], 16), bytes.fromhex(match[2].decode("ascii"))))
            elif text is None or text.strip() not in (b"", b"OK"):
                self.errors += 1
        return frames
