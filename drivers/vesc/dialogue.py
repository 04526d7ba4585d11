"""What a VESC is asked: its firmware first, then the same selection of values again and again."""

from __future__ import annotations

import struct

from drivers.base import DriverCounters
from drivers.polling.poller import Reply, Request
from drivers.vesc.packets import PacketReader
from drivers.vesc.requests import CHECK_MASK, FW_VERSION, GET_VALUES_SELECTIVE, POLL_MASKS, request
from drivers.vesc.values import CHECKED, Firmware, decode_firmware, layout_of
from servo_daemon.errors import WireError

_HELLO = -1  # the tag of the question after the firmware: no mask
#: How the answers to polls begin, by that beginning: the tag, and what they hold.
_LAYOUTS = {
    bytes([GET_VALUES_SELECTIVE]) + mask.to_bytes(4, "big"): (mask, layout_of(mask, CHECKED))
    for mask in (*POLL_MASKS, CHECK_MASK)
}

#: The values of one poll, in steps; see `values.values_of`. A seldom one's are one more: those of `CHECKED`.
Polled = tuple[int, ...]


class VescDialogue:
    """Requests and replies of one drive.

    Args:
        can_id: of a drive behind the one on the line; None: that one itself.
        counters: bytes and payloads that cannot be read are counted here.
        check_every: one of so many polls is a seldom one.

    Attributes:
        firmware: what the drive said of itself; None until it has.
    """

    def __init__(self, can_id: int | None, counters: DriverCounters, check_every: int) -> None:
        self.firmware: Firmware | None = None
        self._reader, self._counters = PacketReader(counters), counters
        self._hello = Request(request(bytes([FW_VERSION]), can_id), _HELLO)
        *self._polls, self._check = (
            Request(request(bytes([GET_VALUES_SELECTIVE]) + mask.to_bytes(4, "big"), can_id), mask)
            for mask in (*POLL_MASKS, CHECK_MASK)
        )
        self._turn, self._check_every = 0, check_every

    def next_request(self) -> Request:
        if self.firmware is None:
            return self._hello
        self._turn += 1
        if self._turn % self._check_every == 0:
            return self._check
        return self._polls[self._turn % len(self._polls)]

    def feed(self, data: bytes) -> list[Reply[Firmware | Polled]]:
        replies = []
        for payload in self._reader.feed(data):
            try:
                replies.append(self._read(payload))
                self._counters.frames += 1
            except (WireError, KeyError, struct.error):  # whole and well-formed, but no answer to what we ask
                self._counters.unknown_frames += 1
        return replies

    def _read(self, payload: bytes) -> Reply[Firmware | Polled]:
        if payload[0] == FW_VERSION:
            self.firmware = decode_firmware(payload)
            return Reply(_HELLO, self.firmware)
        tag, layout = _LAYOUTS[payload[:5]]
        return Reply(tag, layout.unpack(payload))
