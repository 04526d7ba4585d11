"""The one query that is sent to a moteus, and its answers.

A frame has subframes: a code (0x10 read, 0x20 reply; +0 int8, +8 int32, +12 float; the low two bits are the number of
registers, 0: it follows), the number of the first register, and in a reply the values, little-endian (moteus,
docs/protocol/can.md). The layout of a reply is that of its query, so a fixed query has a fixed reply, and many replies
are decoded as one array. Floating point values that are not available are NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Read: 1 int8 from 0x000 (mode); 5 floats from 0x001 (position, velocity, torque, q and d current); 1 float 0x007
#: (power); 1 float 0x00d (voltage); 2 int8 from 0x00e (temperature, fault); 1 int32 0x070 (millisecond counter).
QUERY = bytes.fromhex("11001c05011d071d0d120e1970")
#: Fills a frame up: "no operation".
NOP = 0x50
#: The source of the query, to which the drive answers, and the bit that asks for an answer.
HOST_ID, ASKS = 0x00, 0x8000
#: Drives have 7 bits; 0x7f is all of them at once.
MOST_ID = 126

REPLY = np.dtype(
    [
        ("of_mode", "V2"), ("mode", "i1"),
        ("of_floats", "V3"), ("position", "<f4"), ("velocity", "<f4"), ("torque", "<f4"),
        ("q_current", "<f4"), ("d_current", "<f4"),
        ("of_power", "V2"), ("power", "<f4"),
        ("of_voltage", "V2"), ("voltage", "<f4"),
        ("of_state", "V2"), ("temperature", "i1"), ("fault", "i1"),
        ("of_counter", "V2"), ("counter_ms", "<u4"),
    ]
)  # fmt: skip
#: What stands in the reply for the subframes' codes and registers.
_CODES = {
    "of_mode": bytes.fromhex("2100"), "of_floats": bytes.fromhex("2c0501"), "of_power": bytes.fromhex("2d07"),
    "of_voltage": bytes.fromhex("2d0d"), "of_state": bytes.fromhex("220e"), "of_counter": bytes.fromhex("2970"),
}  # fmt: skip
_PLACES = tuple((REPLY.fields[name][1], code) for name, code in _CODES.items()) if REPLY.fields else ()


def request_id(drive_id: int) -> int:
    """Identifier of a query to a drive (extended: it is beyond 11 bits)."""
    return ASKS | HOST_ID << 8 | drive_id


def command_id(drive_id: int) -> int:
    """Identifier of what a drive does not answer."""
    return HOST_ID << 8 | drive_id


def reply_id(drive_id: int) -> int:
    """Identifier of the drive's answer."""
    return drive_id << 8 | HOST_ID


def is_reply(data: bytes) -> bool:
    """Whether a frame is an answer to `QUERY`."""
    if len(data) < REPLY.itemsize or data[REPLY.itemsize :].strip(bytes([NOP])):
        return False
    return all(data[at : at + len(code)] == code for at, code in _PLACES)


def replies(frames: list[bytes]) -> NDArray[np.void]:
    """The answers as records of `REPLY`, shape (n,). Each has passed `is_reply`."""
    return np.frombuffer(b"".join(f[: REPLY.itemsize] for f in frames), REPLY)
