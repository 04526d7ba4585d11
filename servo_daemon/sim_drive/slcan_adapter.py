"""The command side of a USB-CAN adapter: the ASCII protocol of LAWICEL's CAN232/CANUSB, spoken by most of them.

A command is a line that ends in CR; the answer is CR (or a value and CR) for done, BEL for refused
(LAWICEL, CANUSB manual, "CAN232/CANUSB ASCII protocol").
"""

from __future__ import annotations

import string
from collections.abc import Callable
from dataclasses import dataclass

CR, BEL = b"\r", b"\a"
VERSION, SERIAL_NUMBER = b"V1013", b"NSD01"
#: Longest command: T, eight digits of identifier, one of length, sixteen of data.
MAX_COMMAND = 32

_HEX = frozenset(string.hexdigits.encode())
#: Digits of the identifier, by command that sends a frame.
_SENDS = {ord("t"): 3, ord("T"): 8, ord("r"): 3, ord("R"): 8}


@dataclass(frozen=True, slots=True)
class BusFrame:
    """A data frame on the bus."""

    frame_id: int
    data: bytes
    extended: bool = False


class SlcanAdapter:
    """State and answers of the adapter. `channel_open` says whether frames may be sent to the host.

    Attributes:
        on_bus: data frames that the host has put on the bus; who reads them empties the list.
    """

    def __init__(self) -> None:
        self.channel_open = False
        self.on_bus: list[BusFrame] = []
        self.timestamps = False
        self._listen_only = False
        self._line = bytearray()

    def feed(self, received: bytes) -> bytes:
        """Bytes from the host in any portions; the answers to the commands they complete."""
        answers = bytearray()
        for byte in received:
            if byte == CR[0]:
                answers += self._answer(bytes(self._line))
                self._line.clear()
            elif len(self._line) < MAX_COMMAND:
                self._line.append(byte)
        return bytes(answers)

    def frame_line(self, frame_id: int, data: bytes, time_ms: int, *, extended: bool = False) -> bytes:
        """A received frame as the host gets it; with a time stamp of 0..59999 ms after `Z1`."""
        stamp = b"%04X" % (time_ms % 60_000) if self.timestamps else b""
        head = b"T%08X" % frame_id if extended else b"t%03X" % frame_id
        return b"%s%d%s%s\r" % (head, len(data), data.hex().upper().encode(), stamp)

    def _answer(self, line: bytes) -> bytes:
        if not line:
            return CR
        command, arguments = line[0], line[1:]
        if command in _SENDS:
            return self._send(command, arguments)
        answers: dict[int, Callable[[], bytes]] = {
            ord("S"): lambda: self._set_up(len(arguments) == 1 and arguments in b"012345678"),
            ord("s"): lambda: self._set_up(len(arguments) in (4, 6) and _HEX.issuperset(arguments)),
            ord("M"): lambda: self._set_up(len(arguments) == 8 and _HEX.issuperset(arguments)),
            ord("m"): lambda: self._set_up(len(arguments) == 8 and _HEX.issuperset(arguments)),
            ord("O"): lambda: self._open(listen_only=False),
            ord("L"): lambda: self._open(listen_only=True),
            ord("C"): self._close,
            ord("F"): lambda: b"F00" + CR if self.channel_open else BEL,
            ord("Z"): lambda: self._stamp(arguments),
            ord("V"): lambda: VERSION + CR,
            ord("N"): lambda: SERIAL_NUMBER + CR,
        }
        return answers[command]() if command in answers else BEL

    def _set_up(self, valid: bool) -> bytes:
        return CR if valid and not self.channel_open else BEL

    def _open(self, listen_only: bool) -> bytes:
        if self.channel_open:
            return BEL
        self.channel_open, self._listen_only = True, listen_only
        return CR

    def _close(self) -> bytes:
        if not self.channel_open:
            return BEL
        self.channel_open = False
        return CR

    def _stamp(self, arguments: bytes) -> bytes:
        if self.channel_open or arguments not in (b"0", b"1"):
            return BEL
        self.timestamps = arguments == b"1"
        return CR

    def _send(self, command: int, arguments: bytes) -> bytes:
        """A frame onto the bus: a well-formed one is acknowledged, and kept for the devices there."""
        digits = _SENDS[command]
        length = arguments[digits : digits + 1]
        if not self.channel_open or self._listen_only or not length or length not in b"012345678":
            return BEL
        payload = 0 if command in b"rR" else 2 * int(length)
        if len(arguments) != digits + 1 + payload or not _HEX.issuperset(arguments):
            return BEL
        if command in b"tT":
            data = bytes.fromhex(arguments[digits + 1 :].decode())
            self.on_bus.append(BusFrame(int(arguments[:digits], 16), data, command == ord("T")))
        return (b"z" if command in b"tr" else b"Z") + CR
