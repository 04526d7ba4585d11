"""A moteus with its q voltage: its registers, and beside them `servo_control.q_V` from the diagnostic channel.

Four frames make a round: the voltage is asked for, the registers are read, and twice the drive is asked what it has to
say. It is answered text by text, so that an answer that is late would be taken for the next round's: a round without
its voltage is none, and nothing new is asked before the drive has said all it had to say.
"""

from __future__ import annotations

import struct

import numpy as np

from drivers.can.decode import EXTENDED
from drivers.moteus import fdcanusb, query, telemetry
from drivers.moteus.answers import Answers
from drivers.polling.can_link import Frame, pack, padded
from drivers.polling.poller import Reply, Request
from servo_daemon.errors import WireError
from servo_daemon.samples import F64

_NAME, _FIELD = "servo_control", "q_V"
_GET, _SCHEMA = (telemetry.write(f"tel {verb} {_NAME}") for verb in ("get", "schema"))
#: So many answers of up to 61 bytes bring what `tel get` has to say: 24 bytes and eleven floats.
_POLLS = 2
#: Frames of a round; the voltage is asked for in the first, the registers are read in the second.
FRAMES, REGISTERS_AFTER = 2 + _POLLS, 1
#: From the moment of the registers to that of the voltage, as a share of a round trip.
TO_VOLTAGE = -REGISTERS_AFTER / FRAMES
_VOLTAGE = struct.Struct("<f")


def may_send(drive_id: int) -> frozenset[Frame]:
    """Everything that may leave, as frames: reads."""
    return frozenset({*_round(drive_id, _GET), *_round(drive_id, _SCHEMA)})


def _round(drive_id: int, text: bytes | None) -> list[Frame]:
    """A line for the drive, which is not answered, the query, and polls; None: polls alone."""
    asking, command = query.request_id(drive_id) | EXTENDED, query.command_id(drive_id) | EXTENDED
    polls = [Frame(asking, telemetry.poll())] * _POLLS
    return polls if text is None else [Frame(command, text), Frame(asking, query.QUERY), *polls]


class VoltageQuery(Answers):
    """Rounds. A value is the answer to the query, and behind
    it the voltage, a float.

    Attributes:
        unread: in words, why there is no voltage; None: nothing is known against it.
    """

    def __init__(self, drive_id: int, *, text: bool) -> None:
        super().__init__(drive_id, text=text)
        self._drive_id = drive_id
        self._place: int | None = None
        self._waits_for: str | None = None  # what the drive is to announce
        self._draining = False  # the drive may still have something to say
        self._told, self._polls, self._registers, self._quiet = b"", 0, b"", True
        self.unread: str | None = None

    def next_request(self) -> Request | None:
        if self.unread is not None:
            return None
        self._polls, self._registers, self._quiet = 0, b"", True
        text = None
        if not self._draining:
            self._told = b""
            self._waits_for, text = (f"schema {_NAME}", _SCHEMA) if self._place is None else (f"emit {_NAME}", _GET)
        frames = _round(self._drive_id, text)
        if self._lines is None:
            return Request(b"".join(pack(Frame(f.key, padded(f.data, query.NOP))) for f in frames))
        return Request(b"".join(fdcanusb.sent(f.key & ~EXTENDED, f.data) for f in frames))

    def feed(self, data: bytes) -> list[Reply[bytes]]:
        """Whole rounds; an empty value where one brought no sample."""
        replies: list[Reply[bytes]] = []
        for payload in self._payloads(data):
            told = telemetry.said(payload)
            if told is not None:
                self._told += told
                self._polls += 1
                self._quiet = self._quiet and not told
            elif query.is_reply(payload):
                self._registers = payload[: query.REPLY.itemsize]
            else:
                self._strange += 1
            if self._polls == _POLLS:
                self._polls = 0
                replies.append(Reply(0, self._closed()))
        return replies

    def _closed(self) -> bytes:
        """The value of a round that is over."""
        found = None if self._waits_for is None else telemetry.announced(self._told, self._waits_for)
        late = self._draining
        if found is None:
            self._draining = not (late and self._quiet)
            return b""
        self._waits_for, self._draining = None, False
        if self._place is None:
            try:
                self._place = telemetry.place_of(found, _FIELD)
            except WireError as error:
                self.unread = str(error)
            return b""
        if late:  # the registers are of another moment
            return b""
        voltage = found[self._place : self._place + _VOLTAGE.size]
        return self._registers + voltage if self._registers and len(voltage) == _VOLTAGE.size else b""


def voltages(values: list[bytes]) -> F64:
    """Of the values of rounds, shape (n,), V; NaN for all that is no number."""
    raw = np.frombuffer(b"".join(v[query.REPLY.itemsize :] for v in values), "<f4").astype(np.float64)
    return np.where(np.isfinite(raw), raw, np.nan)
