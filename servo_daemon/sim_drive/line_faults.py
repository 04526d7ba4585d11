"""What goes wrong on a serial line, on purpose: faults for tests and demonstrations, by frame number or on demand."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Mapping
from enum import Enum


class Fault(Enum):
    """One thing that happens to one frame."""

    DROP = "drop"  # the frame never goes out
    REPEAT = "repeat"  # it goes out twice
    CORRUPT = "corrupt"  # one of its bytes changes
    CUT = "cut"  # its second half is missing, delimiter included
    GARBAGE = "garbage"  # a burst of noise goes out before it
    RESTART = "restart"  # the device restarts before it: time, numbering and encoder count begin at 0


class LineFaults:
    """Decides for every sample frame what happens to it.

    Args:
        at: frame number (0 is the first since the start) -> fault.
    """

    def __init__(self, at: Mapping[int, Fault] | None = None) -> None:
        self._at = dict(at or {})
        self._now: deque[Fault] = deque()
        self._random = random.Random(1)  # so that a run can be repeated

    def inject(self, fault: Fault) -> None:
        """Let this happen to the next frame. From any thread; several faults take one frame each."""
        self._now.append(fault)

    def next_fault(self, frame: int) -> Fault | None:
        """What happens to this frame."""
        planned = self._at.get(frame)
        if planned is not None:
            return planned
        return self._now.popleft() if self._now else None

    def spoil(self, fault: Fault | None, wire: bytes) -> bytes:
        """The bytes that go out instead of `wire`, one frame with its end mark (RESTART changes no bytes)."""
        match fault:
            case Fault.DROP:
                return b""
            case Fault.REPEAT:
                return wire + wire
            case Fault.CORRUPT:
                place = self._random.randrange(len(wire) - 1)  # not the end mark: this frame only
                other = (wire[place] % 255) + 1  # never 0, never the same (255 becomes 1)
                return wire[:place] + bytes([other]) + wire[place + 1 :]
            case Fault.CUT:
                return wire[: len(wire) // 2]
            case Fault.GARBAGE:
                return self._random.randbytes(200) + wire[-1:] + wire
            case _:
                return wire
