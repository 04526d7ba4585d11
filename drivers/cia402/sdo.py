"""Reading objects by SDO, one after the other (CiA 301, expedited upload)."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from drivers.cia402.objects import Object
from drivers.polling.can_link import Frame, pack, unpack
from drivers.polling.poller import Reply, Request

#: Identifiers of requests and answers, without the node's number; the codes of upload and abort.
REQUEST_ID, ANSWER_ID = 0x600, 0x580
_UPLOAD, _ABORT = 0x40, 0x80


def upload(node_id: int, thing: Object) -> Frame:
    """The request for an object."""
    return Frame(REQUEST_ID + node_id, struct.pack("<BHB4x", _UPLOAD, thing.index, thing.sub))


def answer(data: bytes) -> tuple[tuple[int, int], bytes | None, int] | None:
    """Index and subindex, value (None: refused) and abort code of an answer; None: it is none of an upload."""
    if len(data) != 8:
        return None
    code, index, sub = struct.unpack_from("<BHB", data)
    if code == _ABORT:
        return (index, sub), None, struct.unpack_from("<I", data, 4)[0]
    if code >> 5 != 2 or not code & 2:  # not the answer to an upload, or not all in this frame
        return None
    size = 4 - (code >> 2 & 3) if code & 1 else 4
    return (index, sub), data[4 : 4 + size], 0


def number(thing: Object, data: bytes) -> float | None:
    """The value of an object, in steps; None: it has another size."""
    if len(data) * 8 != thing.bits:
        return None
    if thing.real:
        return float(struct.unpack("<f", data)[0])
    return float(int.from_bytes(data, "little", signed=thing.signed))


class Uploads:
    """Objects asked for in turn, for ever. The k-th request is for object k modulo their number.

    Attributes:
        refused: object -> abort code, of those that the drive does not give.
    """

    def __init__(self, node_id: int, objects: Sequence[Object]) -> None:
        self._requests = [Request(pack(upload(node_id, o)), k) for k, o in enumerate(objects)]
        self._places = {o.key: (k, o) for k, o in enumerate(objects)}
        self._asked = 0
        self.refused: dict[tuple[int, int], int] = {}
        self.strange = 0

    def next_request(self) -> Request:
        request = self._requests[self._asked % len(self._requests)]
        self._asked += 1
        return request

    def feed(self, data: bytes) -> list[Reply[float]]:
        """The values that these frames carry; NaN where the drive refuses one."""
        replies = []
        for frame in unpack(data):
            read = answer(frame.data)
            place = None if read is None else self._places.get(read[0])
            if read is None or place is None:
                self.strange += 1
                continue
            k, thing = place
            value = None if read[1] is None else number(thing, read[1])
            if read[1] is None:
                self.refused[thing.key] = read[2]
            self.strange += read[1] is not None and value is None
            replies.append(Reply(k, float("nan") if value is None else value))
        return replies
