"""What comes from a moteus, over an fdcanusb adapter (text) or a CAN bus (frames)."""

from __future__ import annotations

from drivers.can.decode import EXTENDED
from drivers.moteus import fdcanusb, query
from drivers.polling.can_link import unpack


class Answers:
    """The payloads of one drive; what a subclass asks for, it reads from them.

    Args:
        text: over an fdcanusb adapter.
    """

    def __init__(self, drive_id: int, *, text: bool) -> None:
        self._reply_id = query.reply_id(drive_id)
        self._lines = fdcanusb.Lines() if text else None
        self._strange = 0

    def take_strange(self) -> int:
        """Frames and lines since the last time that are no answer."""
        strange, self._strange = self._strange, 0
        if self._lines is not None:
            strange, self._lines.errors = strange + self._lines.errors, 0
        return strange

    def _payloads(self, data: bytes) -> list[bytes]:
        """What the drive has said in these bytes."""
        if self._lines is not None:
            frames = self._lines.feed(data)
        else:
            frames = [(f.key & ~EXTENDED, f.data) for f in unpack(data)]
        return [payload for frame_id, payload in frames if frame_id == self._reply_id]
