"""`servo-daemon sim-drive`: a simulated drive that speaks the real wire on a pseudo-terminal."""

from __future__ import annotations

import argparse
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from servo_daemon.commands import sim_makes
from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.effect_flag import add_effect
from servo_daemon.commands.shared.numbers import positive

if TYPE_CHECKING:
    from servo_daemon.sim_drive.source import Drive

HELP = "a simulated drive that speaks the real wire on a pseudo-terminal, until it is stopped"
EXAMPLE = """  servo-daemon sim-drive --serial /tmp/servo0    # then: driver = "serial", port = "/tmp/servo0"
  servo-daemon sim-drive --slcan /tmp/can0       # then: driver = "can", interface = "slcan", channel = "/tmp/can0"
  servo-daemon sim-drive --vesc /tmp/vesc0       # then: driver = "vesc", port = "/tmp/vesc0"
  servo-daemon sim-drive --odrive 0.6 /tmp/can0  # then: driver = "odrive", interface and channel as above"""


_REVERSED: dict[str, Literal["current_A", "position_rad"]] = {"current": "current_A", "encoder": "position_rad"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    wire = parser.add_mutually_exclusive_group(required=True)
    wire.add_argument("--serial", type=Path, metavar="LINK", help="serial line: LINK becomes a link to its terminal")
    wire.add_argument("--slcan", type=Path, metavar="LINK", help="a USB-CAN adapter speaking SLCAN, with the drive")
    sim_makes.add_arguments(wire)
    parser.add_argument("--wire", choices=("binary", "text"), default="binary", help="of the serial line")
    parser.add_argument("--drive-id", type=int, default=1, help="the drive's number on the wire (default: 1)")
    parser.add_argument("--rate", type=positive, default=None, metavar="HZ", help="samples a second (default: 1000)")
    parser.add_argument("--seed", type=int, default=0, help="same seed, same motor noise (default: 0)")
    add_effect(parser, "an effect the motor has")
    parser.add_argument(
        "--ageing", nargs="+", action="extend", default=None, metavar="P=±%/T", help="default: ages like `run`'s motor"
    )
    parser.add_argument(
        "--commands",
        action="store_true",
        help="take commands of `commission` over the serial line; stands still until one comes, and does not age",
    )
    parser.add_argument(
        "--reversed",
        choices=sorted(_REVERSED),
        default=None,
        help="a sensor that was wired the wrong way round (--serial, --slcan)",
    )
    parser.add_argument("--seconds", type=positive, default=None, help="stop after this long (default: never)")


def run(arguments: argparse.Namespace) -> int:
    _check(arguments)
    stop = threading.Event()
    for number in common.stop_signals():
        signal.signal(number, lambda *_: stop.set())
    if arguments.seconds is not None:
        timer = threading.Timer(arguments.seconds, stop.set)
        timer.daemon = True
        timer.start()
    if sim_makes.is_asked_for(arguments):
        sim_makes.serve(arguments, stop)
        return 0
    rate_hz = 1000.0 if arguments.rate is None else arguments.rate
    if arguments.commands and arguments.ageing is None:
        arguments.ageing = []
    from servo_daemon.sim_drive.source import Reversed

    source: Drive = sim_makes.brushed_motor(arguments)
    if arguments.reversed is not None:
        source = Reversed(source, _REVERSED[arguments.reversed])
    link = arguments.serial or arguments.slcan
    common.note(f"{link}: drive {arguments.drive_id}, {rate_hz:g} samples a second; Ctrl-C ends it")
    if arguments.serial is not None:
        from servo_daemon.sim_drive.serial_device import run_serial_device

        commanded = source if arguments.commands else None
        run_serial_device(
            link, source, wire=arguments.wire, drive_id=arguments.drive_id, stop=stop, commanded=commanded
        )
    else:
        from servo_daemon.sim_drive.slcan_device import run_slcan_device

        run_slcan_device(link, source, drive_id=arguments.drive_id, stop=stop)
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuse what the wire cannot carry.

    Raises:
        BadInputError: naming the flag.
    """
    from drivers.can.ours.wire import FIRST_DRIVE, LAST_DRIVE
    from servo_daemon.errors import BadInputError

    lowest, highest = (FIRST_DRIVE, LAST_DRIVE) if arguments.slcan is not None else (0, 255)
    if arguments.odrive:
        highest = 63
    elif sim_makes.is_asked_for(arguments):
        highest = 126  # of moteus; the others have more
    if arguments.rate is not None and arguments.rate > 1e5:
        raise BadInputError(f"--rate must be at most 100000, not {arguments.rate:g}")
    if not lowest <= arguments.drive_id <= highest:
        raise BadInputError(f"--drive-id {arguments.drive_id} is outside {lowest} .. {highest}")
    if arguments.commands and (arguments.serial is None or arguments.wire != "binary"):
        raise BadInputError("--commands is for --serial with the binary wire: the others carry no commands")
    if arguments.reversed is not None and arguments.serial is None and arguments.slcan is None:
        raise BadInputError("--reversed is for --serial and --slcan")
    if arguments.seconds is not None and arguments.seconds > threading.TIMEOUT_MAX:
        raise BadInputError(f"--seconds must be at most {threading.TIMEOUT_MAX:g}, not {arguments.seconds:g}")
