"""Who is there, asked on a serial port: reads that every drive of a make answers, with its number on the line."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

from drivers.moteus import fdcanusb, query
from drivers.moteus.drive import may_send
from drivers.polling.link import SerialLink
from drivers.serial.port import open_port
from drivers.servo_bus.families import Family

#: A servo answers within its return delay (0.5 ms) and some bytes, a moteus within a frame; then the next is asked, so
#: that on a half-duplex line no question meets an answer. USB adapters deliver up to 16 ms later: once, at the end.
_EACH_S, _LAST_S = 0.003, 0.1
#: The rate of an fdcanusb, which is USB: of no account.
_FDCANUSB_BAUD = 921_600


def servos_on(port: str, baudrate: int, family: Family) -> list[int]:
    """Numbers of the servos that answer.

    Raises:
        DriverError: the port cannot be opened.
        OSError: it goes away.
    """
    decoder, found = family.decoder(), set[int]()
    for data in _said(port, baudrate, family.search):
        found |= {status.servo for status in decoder.feed(data) if len(status.data) == 3}
    return sorted(found)


def moteus_on(port: str) -> list[int]:
    """Numbers of the moteus drives behind an fdcanusb that answer the driver's own query.

    Raises:
        DriverError: the port cannot be opened.
        OSError: it goes away.
    """
    lines, found = fdcanusb.Lines(), set[int]()
    questions = (may_send(drive_id)[0] for drive_id in range(1, query.MOST_ID + 1))
    for data in _said(port, _FDCANUSB_BAUD, questions):
        found |= {frame_id >> 8 for frame_id, payload in lines.feed(data) if query.is_reply(payload)}
    return sorted(found)


def _said(port: str, baudrate: int, questions: Iterable[bytes]) -> Iterator[bytes]:
    """What comes back while these questions are asked one after the other."""
    link = SerialLink(open_port("scan", port, baudrate))
    try:
        for question in questions:
            link.send(question)
            yield from within(link, _EACH_S)
        yield from within(link, _LAST_S)
    finally:
        link.close()


def within(link: SerialLink, seconds: float) -> Iterator[bytes]:
    """What comes within so many seconds."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        yield link.receive(left)
