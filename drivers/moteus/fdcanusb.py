"""The text of an fdcanusb adapter: one line a frame (mjbots/fdcanusb, README).

host     can send <id hex> <data hex> b        b: with the faster rate for the data
adapter  OK                                    or ERR and a reason
adapter  rcv <id hex> <data hex> <flags…>
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
        for line in lines:
            match = _RECEIVED.fullmatch(line)
            if match is not None:
                frames.append((int(match[1], 16), bytes.fromhex(match[2].decode("ascii"))))
            elif line.strip() not in (b"", b"OK"):
                self.errors += 1
        return frames
