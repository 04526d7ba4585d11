"""`servo-daemon sim-drive`: a simulated drive that speaks the real wire on a pseudo-terminal."""

from __future__ import annotations

import argparse
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.commands.shared import common

if TYPE_CHECKING:
    from servo_daemon.sim_drive.makes.serve import Device
    from servo_daemon.simulate import SimulatedDrive

HELP = "a simulated drive that speaks the real wire on a pseudo-terminal, until it is stopped"
EXAMPLE = """  servo-daemon sim-drive --serial /tmp/servo0    # then: driver = "serial", port = "/tmp/servo0"
  servo-daemon sim-drive --slcan /tmp/can0       # then: driver = "can", interface = "slcan", channel = "/tmp/can0"
  servo-daemon sim-drive --moteus /tmp/moteus    # then: driver = "moteus", port = "/tmp/moteus\""""

#: Makes whose link is a USB-CAN adapter (SLCAN).
_ON_CAN = ("cia402", "mit")
_MAKES = ("vesc", "moteus", "dynamixel", "feetech", "simplefoc", *_ON_CAN)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    wire = parser.add_mutually_exclusive_group(required=True)
    wire.add_argument("--serial", type=Path, metavar="LINK", help="serial line: LINK becomes a link to its terminal")
    wire.add_argument("--slcan", type=Path, metavar="LINK", help="a USB-CAN adapter speaking SLCAN, with the drive")
    for make in _MAKES:
        what = "a USB-CAN adapter (SLCAN) with such a drive" if make in _ON_CAN else "the serial line of such a drive"
        wire.add_argument(f"--{make}", type=Path, metavar="LINK", help=what)
    wire.add_argument(
        "--odrive", nargs=2, metavar=("0.5|0.6", "LINK"), help="0.5: its text on a serial line; 0.6: on SLCAN"
    )
    parser.add_argument("--wire", choices=("binary", "text"), default="binary", help="of the serial line")
    parser.add_argument("--drive-id", type=int, default=1, help="the drive's number on the wire (default: 1)")
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help="samples a second (default: 1000)")
    parser.add_argument("--seed", type=int, default=0, help="same seed, same motor noise (default: 0)")
    parser.add_argument("--effect", action="append", default=[], metavar="NAME[:k=v,…]", help="repeatable")
    parser.add_argument(
        "--ageing", nargs="+", action="extend", default=None, metavar="P=±%/T", help="default: ages like `run`'s motor"
    )
    parser.add_argument("--seconds", type=float, default=None, help="stop after this long (default: never)")


def run(arguments: argparse.Namespace) -> int:
    _check(arguments)
    stop = threading.Event()
    for number in common.stop_signals():
        signal.signal(number, lambda *_: stop.set())
    if arguments.seconds is not None:
        timer = threading.Timer(arguments.seconds, stop.set)
        timer.daemon = True
        timer.start()
    make, link = _make_of(arguments)
    if make is not None:
        from servo_daemon.sim_drive.makes.serve import serve

        serve(link, _device(make, link, arguments), stop=stop)
        return 0
    source = _brushed(arguments)
    link = arguments.serial or arguments.slcan
    common.note(f"{link}: drive {arguments.drive_id}, {arguments.rate:g} samples a second; Ctrl-C ends it")
    if arguments.serial is not None:
        from servo_daemon.sim_drive.serial_device import run_serial_device

        run_serial_device(link, source, wire=arguments.wire, drive_id=arguments.drive_id, stop=stop)
    else:
        from servo_daemon.sim_drive.slcan_device import run_slcan_device

        run_slcan_device(link, source, drive_id=arguments.drive_id, stop=stop)
    return 0


def _make_of(arguments: argparse.Namespace) -> tuple[str | None, Path]:
    """The make that was asked for, as the catalogue names it, and its link; None: our own wire."""
    if arguments.odrive is not None:
        return f"odrive-{arguments.odrive[0]}", Path(arguments.odrive[1])
    for make in _MAKES:
        link = getattr(arguments, make)
        if link is not None:
            return make, link
    return None, Path()


def _brushed(arguments: argparse.Namespace) -> SimulatedDrive:
    """The brushed motor that the flags describe."""
    from servo_daemon.simulate import DEFAULT_AGEING, DEFAULT_J_M, SimulatedDrive, make_settings

    return SimulatedDrive(
        make_settings(
            J_m=DEFAULT_J_M,
            effects=arguments.effect,
            ageing=DEFAULT_AGEING if arguments.ageing is None else arguments.ageing,
            rate_hz=arguments.rate,
            seed=arguments.seed,
        )
    )


def _device(make: str, link: Path, arguments: argparse.Namespace) -> Device:
    """The simulated drive of a make; its motor is told."""
    from servo_daemon.errors import BadInputError
    from servo_daemon.sim_drive.makes.catalogue import BRUSHED, FOC, truth

    if make in BRUSHED:
        common.note(f"{link}: {make} {arguments.drive_id}, a brushed motor; Ctrl-C ends it")
        return BRUSHED[make](_brushed(arguments), arguments.drive_id)
    if make not in FOC:
        raise BadInputError(f"--odrive {make.removeprefix('odrive-')}: there are 0.5 and 0.6")
    if arguments.effect or arguments.ageing is not None:
        raise BadInputError(f"--effect and --ageing are for the brushed motor, which --{make} does not have")
    values = ", ".join(f"{name} {value:g}" for name, value in truth(make).items())
    common.note(f"{link}: {make} {arguments.drive_id} with {values} (phase values, SI units); Ctrl-C ends it")
    return FOC[make](arguments.seed, arguments.drive_id)


def _check(arguments: argparse.Namespace) -> None:
    """Refuse what the wire cannot carry.

    Raises:
        BadInputError: naming the flag.
    """
    from drivers.can.wire import FIRST_DRIVE, LAST_DRIVE
    from servo_daemon.errors import BadInputError

    lowest, highest = (FIRST_DRIVE, LAST_DRIVE) if arguments.slcan is not None else (0, 255)
    if _make_of(arguments)[0] is not None:
        highest = 126  # the least of what the wires have: moteus
    if not lowest <= arguments.drive_id <= highest:
        raise BadInputError(f"--drive-id {arguments.drive_id} is outside {lowest} .. {highest}")
    if arguments.seconds is not None and not 0.0 < arguments.seconds <= threading.TIMEOUT_MAX:
        raise BadInputError(f"--seconds must be greater than zero, not {arguments.seconds:g}")
