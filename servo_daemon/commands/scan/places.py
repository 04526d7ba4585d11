"""Where drives may be: serial ports and CAN buses, and what on them is worth a closer look."""

from __future__ import annotations

import time
from collections.abc import Iterator

from drivers.polling.link import SerialLink
from drivers.serial.port import open_port
from drivers.servo_bus.families import DynamixelX, Family, FeetechSts
from servo_daemon.commands.scan.asking import moteus_on, servos_on, within
from servo_daemon.commands.scan.finding import Candidate, Finding

#: Servos by driver, and the rates at which they may be set: the makers' own first (e-manual of the X series: 57,600).
_SERVOS: tuple[tuple[str, Family, tuple[int, ...]], ...] = (
    ("dynamixel", DynamixelX(fast=True), (57_600, 1_000_000)),
    ("feetech", FeetechSts(), (1_000_000,)),
)
#: Columns of SimpleFOC's monitor, and its rate (Arduino's examples). What it shows is told by all seven being there.
_MONITOR_BAUD, _MONITOR_COLUMNS = 115_200, 7
#: So many lines are looked at.
_ENOUGH_LINES = 5


def on_port(port: str, ask: bool, seconds: float) -> Iterator[list[Candidate | Finding]]:
    """Drives on a serial port, one kind after the other: those that speak by themselves, and those that answer. The
    next kind is looked for, and asked, only when it is taken.

    Raises:
        DriverError: the port cannot be opened.
        OSError: it goes away.
    """
    yield [Candidate("serial", {"port": port})]
    yield _monitor(port, seconds)
    if not ask:
        return
    yield [Candidate("vesc", {"port": port}, asks=True)]
    yield [Candidate("odrive", {"port": port}, asks=True)]
    yield [Candidate("moteus", {"port": port, "drive_id": n}, asks=True) for n in moteus_on(port)]
    for driver, family, rates in _SERVOS:
        for baudrate in rates:
            options = {"port": port, "baudrate": baudrate}
            found = servos_on(port, baudrate, family)
            yield [Candidate(driver, options | {"drive_id": n}, asks=True) for n in found]


def _monitor(port: str, seconds: float) -> list[Candidate | Finding]:
    """A SimpleFOC sketch that prints its monitor: lines of as many numbers, with tabs between them."""
    columns = _columns(port, seconds)
    if columns == _MONITOR_COLUMNS:
        return [Candidate("simplefoc", {"port": port, "monitor": "1" * _MONITOR_COLUMNS})]
    if columns is None:
        return []
    missing = {"monitor": f"motor.monitor_variables of the sketch in binary, seven digits, {columns} of them 1"}
    remark = f"lines of {columns} numbers: they do not tell which they are"
    return [Finding("simplefoc", f"simplefoc:{port}", {"port": port}, remark=remark, missing=missing)]


def _columns(port: str, seconds: float) -> int | None:
    """How many numbers stand in every line; None: these are no lines of a monitor."""
    link = SerialLink(open_port("scan", port, _MONITOR_BAUD))
    text, end = b"", time.monotonic() + seconds
    try:
        for data in within(link, seconds):
            text += data
            if text.count(b"\n") > _ENOUGH_LINES or time.monotonic() > end:
                break
    finally:
        link.close()
    lines = text.split(b"\n")[1:-1]  # the first may have begun before
    counts = {_numbers(line) for line in lines}
    return counts.pop() if len(lines) >= 2 and len(counts) == 1 else None


def _numbers(line: bytes) -> int | None:
    """Of a line as Arduino prints it (`print(value, 4)`, tabs); None: it is another."""
    words = line.strip().split(b"\t")
    if not 2 <= len(words) <= _MONITOR_COLUMNS:
        return None
    plain = all(w.lstrip(b"-").replace(b".", b"", 1).isdigit() and w[-5:-4] == b"." for w in words)
    return len(words) if plain else None
