"""Requests and answers as frames of a CAN bus that other drives may share: `Link` over a `CanPort`."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import can

from drivers.base import DriverCounters
from drivers.can.decode import CLASSIC_BYTES, EXTENDED
from drivers.can.port import CanPort, Inbox

#: A frame as bytes: its key (`frame_key`), the length of its data, the data.
_HEAD = struct.Struct("<IB")


@dataclass(frozen=True, slots=True)
class Frame:
    """A data frame.

    Attributes:
        key: identifier, see `drivers.can.decode.frame_key`.
    """

    key: int
    data: bytes


def pack(frame: Frame) -> bytes:
    """A frame as the bytes of a `Link`."""
    return _HEAD.pack(frame.key, len(frame.data)) + frame.data


def unpack(data: bytes) -> Iterator[Frame]:
    """The frames in bytes that `pack` made."""
    at = 0
    while at + _HEAD.size <= len(data):
        key, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        yield Frame(key, data[at : at + length])
        at += length


class CanLink:
    """A drive's share of a bus.

    Args:
        settings: keyword arguments of `can.Bus`.
        keys: identifiers of the answers.
        counters: the drive's.
        fd: frames of more than 8 bytes may be sent, with the faster rate for their data.

    Raises:
        DriverUnavailableError, DriverConfigError: the bus cannot be opened.
    """

    def __init__(
        self, settings: Mapping[str, Any], keys: frozenset[int], counters: DriverCounters, *, fd: bool = False
    ) -> None:
        self._inbox, self._fd, self._awake = Inbox(keys, counters, prompt=True), fd, threading.Event()
        self._port = CanPort.attach(settings, self._inbox)

    def send(self, data: bytes) -> None:
        for frame in unpack(data):
            message = can.Message(
                arbitration_id=frame.key & ~EXTENDED,
                is_extended_id=bool(frame.key & EXTENDED),
                data=frame.data,
                is_fd=self._fd,
                bitrate_switch=self._fd,
            )
            self._port.send(message)

    def receive(self, timeout_s: float) -> bytes:
        batch = self._port.take(self._inbox, max(0.0, timeout_s), self._awake.is_set)
        if batch is None:
            return b""
        rows = zip(batch.keys.tolist(), batch.lengths.tolist(), batch.data, strict=True)
        return b"".join(pack(Frame(key, row[:length].tobytes())) for key, length, row in rows)

    def pause(self, seconds: float) -> bool:
        return self._awake.wait(max(0.0, seconds))

    def wake(self) -> None:
        self._awake.set()
        self._port.wake()

    def close(self) -> None:
        self._port.detach(self._inbox)


def padded(data: bytes, filler: int) -> bytes:
    """Data filled up to a length that a CAN FD frame can have (ISO 11898-1: 0–8, 12, 16, 20, 24, 32, 48, 64)."""
    lengths = (*range(CLASSIC_BYTES + 1), 12, 16, 20, 24, 32, 48, 64)
    return data.ljust(next(n for n in lengths if n >= len(data)), bytes([filler]))
