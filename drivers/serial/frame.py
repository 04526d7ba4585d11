"""Frames of the binary serial wire: a payload with a CRC, stuffed so that the next frame is found after any damage.

On the wire a frame is ``COBS(payload + CRC) + 00``. COBS (Cheshire and Baker, "Consistent overhead byte stuffing",
IEEE/ACM Trans. Networking 7(2), 1999) leaves no zero inside, so a reader finds the next frame after any damage. The CRC
is CRC-16/IBM-3740 (poly 1021h, init FFFFh, not reflected, no final XOR; check value 29B1h): `binascii.crc_hqx` of the
standard library, Hamming distance 4 up to 4 kB. It is sent high byte first, so the CRC over payload and CRC is 0.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Iterator

from cobs import cobs

from drivers.base import DriverCounters
from servo_daemon.errors import WireError

#: Of the CRC (CRC-16/IBM-3740): what it begins with, its length in bytes; what ends a frame.
CRC_INIT = 0xFFFF
CRC_SIZE = 2
DELIMITER = b"\0"

#: Longest payload (without CRC) a device may send: it fits a small microcontroller and bounds what garbage can cost.
MAX_PAYLOAD = 1024
#: Longest run of bytes without a delimiter that can be a frame: payload, CRC, one COBS code byte for every 254.
MAX_ENCODED = cobs.max_encoded_length(MAX_PAYLOAD + CRC_SIZE)


def encode_frame(payload: bytes) -> bytes:
    """A payload as it goes over the wire: CRC appended, stuffed, delimited.

    Raises:
        ValueError: the payload is empty or longer than `MAX_PAYLOAD`.
    """
    if not 0 < len(payload) <= MAX_PAYLOAD:
        raise ValueError(f"payload of {len(payload)} bytes: 1 .. {MAX_PAYLOAD} are possible")
    return bytes(cobs.encode(payload + crc_hqx(payload, CRC_INIT).to_bytes(CRC_SIZE, "big"))) + DELIMITER


def decode_frame(encoded: bytes) -> bytes:
    """The payload of one frame, given without its delimiter.

    Raises:
        WireError: not a frame, or its CRC is wrong.
    """
    try:
        payload = bytes(cobs.decode(encoded))
    except cobs.DecodeError as error:
        raise WireError(f"not a frame: {error}") from error
    if len(payload) <= CRC_SIZE:
        raise WireError(f"frame of {len(payload)} bytes is too short")
    if crc_hqx(payload, CRC_INIT):
        raise WireError("wrong CRC")
    return payload[:-CRC_SIZE]


class FrameReader:
    """A stream of bytes to payloads. Any bytes may come in; nothing is raised, everything is counted.

    Args:
        counters: `frames`, `framing_errors` and `crc_errors` are counted up here.
    """

    def __init__(self, counters: DriverCounters) -> None:
        self._counters = counters
        self._carry = b""
        self._in_step = False  # whether a delimiter has been seen: what comes before the first is half a frame
        self._discarding = False  # inside an over-long run that has been counted already

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Payloads, with their CRC, of the frames that these bytes complete; to be gone through to its end."""
        *frames, self._carry = (self._carry + data).split(DELIMITER)
        for encoded in frames:
            if encoded or self._discarding:
                payload = self._unstuffed(encoded)
                if payload is not None:
                    self._counters.frames += 1
                    yield payload
            else:
                self._in_step = True
        if len(self._carry) > MAX_ENCODED:
            self._counters.framing_errors += not self._discarding
            self._carry, self._discarding = b"", True

    def _unstuffed(self, encoded: bytes) -> bytes | None:
        """Payload with CRC of what stood between two delimiters; None, and counted, if it is no frame."""
        was_in_step, self._in_step = self._in_step, True
        if self._discarding or len(encoded) > MAX_ENCODED:
            self._counters.framing_errors += not self._discarding
            self._discarding = False
            return None
        try:
            payload = bytes(cobs.decode(encoded))
        except cobs.DecodeError:
            self._counters.framing_errors += was_in_step
            return None
        if crc_hqx(payload, CRC_INIT):
            self._counters.crc_errors += was_in_step
            return None
        if len(payload) <= CRC_SIZE:
            self._counters.framing_errors += was_in_step
            return None
        return payload
