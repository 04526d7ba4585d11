"""The packets of Feetech's STS servos (Feetech, "Magnetic encoding servo communication protocol"): those of Dynamixel's
protocol 1.0, with little-endian registers and a sync read.

    FF FF  id  length  instruction or error  parameters…  sum
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.servo_bus.protocol2 import BROADCAST, Status

#: Begin of a packet; instructions.
HEAD = b"\xff\xff"
READ, SYNC_READ = 0x02, 0x82


def checksum(body: bytes) -> int:
    """Of all after the head: the inverted low byte of the sum."""
    return ~sum(body) & 0xFF


def packet(servo: int, instruction: int, parameters: bytes) -> bytes:
    """A packet of protocol 1, with its checksum."""
    body = bytes([servo, len(parameters) + 2, instruction]) + parameters
    return HEAD + body + bytes([checksum(body)])


def read(servo: int, address: int, length: int) -> bytes:
    """The request for `length` bytes from `address`."""
    return packet(servo, READ, bytes([address, length]))


def sync_read(servos: Sequence[int], address: int, length: int) -> bytes:
    """The request for the same bytes of several servos, each of which answers by itself."""
    return packet(BROADCAST, SYNC_READ, bytes([address, length, *servos]))


class Decoder:
    """Bytes of the line to answers of so many bytes of data as were asked for.

    Args:
        lengths: of the data that is asked for: our own requests, which some adapters echo, have others.

    Attributes:
        crc_errors, framing_errors: packets with a wrong sum; runs of bytes that are no packet.
    """

    def __init__(self, lengths: Sequence[int]) -> None:
        self._lengths = {n + 2 for n in lengths}
        self._most = max(self._lengths)
        self._buffer = b""
        self.crc_errors = self.framing_errors = 0

    def feed(self, data: bytes) -> list[Status]:
        """The answers that these bytes complete."""
        self._buffer += data
        found: list[Status] = []
        while True:
            at = self._buffer.find(HEAD)
            if at < 0:
                self.framing_errors += len(self._buffer) > 1
                self._buffer = self._buffer[-1:] if self._buffer.endswith(b"\xff") else b""
                return found
            self.framing_errors += at > 0
            self._buffer = self._buffer[at:]
            if len(self._buffer) < 4:
                return found
            servo, length = self._buffer[2], self._buffer[3]
            end = 4 + length
            if servo >= BROADCAST or length not in self._lengths:
                self.framing_errors += 1
                self._buffer = self._buffer[1:]
            elif len(self._buffer) < end:
                return found
            elif checksum(self._buffer[2 : end - 1]) != self._buffer[end - 1]:
                self.crc_errors += 1
                self._buffer = self._buffer[1:]
            else:
                found.append(Status(servo, self._buffer[4], self._buffer[5 : end - 1]))
                self._buffer = self._buffer[end:]
