"""VESC packets on a serial line: start byte, length, payload, CRC-16, stop byte.

    02 len      payload crc_high crc_low 03     payloads of up to 255 bytes
    03 len len  payload crc_high crc_low 03     longer ones, big-endian length

The CRC is CCITT with start value 0 (XMODEM), over the payload. As in tests/drivers/golden/vesc.json, whose packets
the firmware's own code made.
"""

from __future__ import annotations

from binascii import crc_hqx

from drivers.base import DriverCounters

#: First byte of a packet whose length is one byte or two; the last byte (the firmware's packet.c).
SHORT, LONG, STOP = 0x02, 0x03, 0x03
#: Longest payload the firmware sends (PACKET_MAX_PL_LEN of its packet.h).
MAX_PAYLOAD = 512


def encode_packet(payload: bytes) -> bytes:
    """The packet of a payload of 1 .. `MAX_PAYLOAD` bytes.

    Raises:
        ValueError: it is empty or longer.
    """
    n = len(payload)
    if not 0 < n <= MAX_PAYLOAD:
        raise ValueError(f"a payload of {n} bytes is none of 1 .. {MAX_PAYLOAD}")
    head = bytes([SHORT, n]) if n < 256 else bytes([LONG]) + n.to_bytes(2, "big")
    return head + payload + crc_hqx(payload, 0).to_bytes(2, "big") + bytes([STOP])


class PacketReader:
    """Bytes in any portions to payloads.

    Args:
        counters: bytes that are no packet count as `framing_errors`, whole packets with a wrong CRC as `crc_errors`.
    """

    def __init__(self, counters: DriverCounters) -> None:
        self._counters = counters
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """The payloads that these bytes complete."""
        buffer = self._buffer
        if not buffer and _is_one_short(data):  # so nearly every answer comes
            return [data[2:-3]]
        buffer += data
        payloads: list[bytes] = []
        at = 0
        while len(buffer) - at >= 2:
            head, length = _head(buffer, at)
            whole = head + length + 3
            if length == 0 or length > MAX_PAYLOAD:
                at += self._no_packet()
            elif len(buffer) - at < whole:
                break
            elif buffer[at + whole - 1] != STOP:
                at += self._no_packet()
            else:
                payload = bytes(buffer[at + head : at + head + length])
                if crc_hqx(payload, 0) != int.from_bytes(buffer[at + head + length : at + whole - 1], "big"):
                    self._counters.crc_errors += 1
                    at += 1  # its first bytes may be the end of another packet
                else:
                    payloads.append(payload)
                    at += whole
        del buffer[:at]
        return payloads

    def _no_packet(self) -> int:
        self._counters.framing_errors += 1
        return 1


def _is_one_short(data: bytes) -> bool:
    """Whether this is one packet of up to 255 bytes and nothing else."""
    if len(data) < 6 or data[0] != SHORT or data[1] != len(data) - 5 or data[-1] != STOP:
        return False
    return crc_hqx(data[2:-3], 0) == data[-3] << 8 | data[-2]


def _head(buffer: bytearray, at: int) -> tuple[int, int]:
    """Bytes before the payload and the payload's length; length 0 where no packet begins."""
    if buffer[at] == SHORT:
        return 2, buffer[at + 1]
    if buffer[at] == LONG and len(buffer) - at >= 3:
        return 3, int.from_bytes(buffer[at + 1 : at + 3], "big")
    return (3, 1) if buffer[at] == LONG else (1, 0)  # of a long one the rest of its length is still to come
