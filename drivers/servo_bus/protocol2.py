"""Dynamixel's protocol 2.0: instruction and status packets (e-manual, "DYNAMIXEL Protocol 2.0"). Little-endian.

    FF FF FD 00  id  length (2)  instruction  parameters…  CRC (2)

In what follows the length, FF FF FD gets a further FD, so that it never looks like the head of a packet; the answer to
a fast sync read has none of that.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

#: Begin of a packet; instructions; the id that all servos answer to.
HEAD = b"\xff\xff\xfd\x00"
PING, READ, SYNC_READ, FAST_SYNC_READ, STATUS = 0x01, 0x02, 0x82, 0x8A, 0x55
BROADCAST = 0xFE
#: Servos have the ids 0 .. 252.
MOST_ID = 252
#: The least packet after the length: instruction and CRC. The most that a chain answers at once: 20 servos of 32 bytes.
_LEAST, _MOST = 3, 1024


def _crc_table() -> tuple[int, ...]:
    """CRC-16 with the polynomial 0x8005, most significant bit first (e-manual, "CRC Calculation")."""
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = crc << 1 ^ (0x8005 if crc & 0x8000 else 0)
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC = _crc_table()


def crc16(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC[crc >> 8 ^ byte]
    return crc


class Status(NamedTuple):
    """What a servo answers: its id, the error byte (bit 7: it has a hardware error), the data."""

    servo: int
    error: int
    data: bytes


def packet(servo: int, instruction: int, parameters: bytes) -> bytes:
    """A packet, stuffed and with its CRC."""
    body = (bytes([instruction]) + parameters).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    head = HEAD + struct.pack("<BH", servo, len(body) + 2) + body
    return head + struct.pack("<H", crc16(head))


def ping() -> bytes:
    """The question who is there: every servo answers with its model's number (2 bytes) and its firmware's."""
    return packet(BROADCAST, PING, b"")


def read(servo: int, address: int, length: int) -> bytes:
    """The request for `length` bytes from `address`."""
    return packet(servo, READ, struct.pack("<HH", address, length))


def sync_read(servos: Sequence[int], address: int, length: int) -> bytes:
    """The request for the same bytes of several servos, each of which answers by itself."""
    return packet(BROADCAST, SYNC_READ, struct.pack("<HH", address, length) + bytes(servos))


def fast_sync_read(servos: Sequence[int], address: int, length: int) -> bytes:
    """The same, answered by all of them in one packet."""
    return packet(BROADCAST, FAST_SYNC_READ, struct.pack("<HH", address, length) + bytes(servos))


class Decoder:
    """Bytes of the line to status packets.

    Args:
        length: of the data that a fast sync read asks for.

    Attributes:
        crc_errors, framing_errors: packets with a wrong CRC; runs of bytes that are no packet.
    """

    def __init__(self, length: int) -> None:
        self._length = length
        self._buffer = b""
        self.crc_errors = self.framing_errors = 0

    def feed(self, data: bytes) -> list[Status]:
        """The answers that these bytes complete; our own requests, which some adapters echo, are passed over."""
        self._buffer += data
        found: list[Status] = []
        while True:
            at = self._buffer.find(HEAD)
            if at < 0:
                keep = len(HEAD) - 1
                self.framing_errors += len(self._buffer) > keep
                self._buffer = self._buffer[-keep:]
                return found
            self.framing_errors += at > 0
            self._buffer = self._buffer[at:]
            if len(self._buffer) < 7:
                return found
            (length,) = struct.unpack_from("<H", self._buffer, 5)
            end = 7 + length
            if not _LEAST <= length <= _MOST:
                self.framing_errors += 1
                self._buffer = self._buffer[1:]
            elif len(self._buffer) < end:
                return found
            elif crc16(self._buffer[: end - 2]) != struct.unpack_from("<H", self._buffer, end - 2)[0]:
                self.crc_errors += 1
                self._buffer = self._buffer[1:]
            else:
                found += self._statuses(self._buffer[4], self._buffer[7 : end - 2])
                self._buffer = self._buffer[end:]

    def _statuses(self, servo: int, body: bytes) -> list[Status]:
        if body[0] != STATUS or len(body) < 2:
            return []
        if servo != BROADCAST:
            plain = body.replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
            return [Status(servo, plain[1], plain[2:])]
        stride = self._length + 4  # error, id, data, and the CRC so far, which is that of the packet for the last
        found = [
            Status(body[at + 1], body[at], body[at + 2 : at + 2 + self._length])
            for at in range(1, len(body), stride)
            if at + 2 + self._length <= len(body)
        ]
        return found if 1 + stride * len(found) - 2 == len(body) else []
