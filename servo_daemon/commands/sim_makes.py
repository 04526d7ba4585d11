"""The simulated drives of other makers that `servo-daemon sim-drive` serves."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.errors import BadInputError

if TYPE_CHECKING:
    from servo_daemon.sim_drive.makes.serve import Device
    from servo_daemon.simulate import SimulatedDrive

#: Status messages a second, where --rate does not say otherwise.
_CAN_HZ = 200.0
_ODRIVE_HZ = 100.0
#: Makes of the catalogue: whether their motor is brushed, and what they are for the user.
_MORE = {
    "moteus": (False, "a moteus behind an fdcanusb adapter, which answers queries"),
    "dynamixel": (True, "a Dynamixel X, which answers reads"),
    "feetech": (True, "a Feetech STS, which answers reads"),
    "simplefoc": (False, "the monitor of a SimpleFOC sketch"),
    "cia402": (False, "a CANopen drive (PDO 1, SDO) behind a USB-CAN adapter"),
    "mit": (False, "an AK80-9 actuator's feedback behind a USB-CAN adapter"),
}


def add_arguments(wire: argparse._MutuallyExclusiveGroup) -> None:
    """The makes, beside the project's own wires."""
    wire.add_argument("--vesc", type=Path, metavar="LINK", help="a VESC on USB or UART, which answers requests")
    wire.add_argument("--vesc-can", type=Path, metavar="LINK", help="a VESC's status messages behind a USB-CAN adapter")
    wire.add_argument(
        "--odrive", nargs=2, metavar=("0.5|0.6", "LINK"), help="an ODrive's CAN messages behind a USB-CAN adapter"
    )
    wire.add_argument("--odrive-text", type=Path, metavar="LINK", help="an ODrive 0.5 on USB, which answers text")

    for make, (_, what) in _MORE.items():
        wire.add_argument(f"--{make}", type=Path, metavar="LINK", help=what)


def is_asked_for(arguments: argparse.Namespace) -> bool:
    """Whether one of them is asked for."""
    return any((arguments.vesc, arguments.vesc_can, arguments.odrive, arguments.odrive_text, _one_more(arguments)))


def _one_more(arguments: argparse.Namespace) -> str | None:
    """Which of `_MORE` is asked for."""
    return next((make for make in _MORE if getattr(arguments, make) is not None), None)


def brushed_motor(arguments: argparse.Namespace) -> SimulatedDrive:
    """The brushed motor that the flags describe."""
    from servo_daemon.simulate import DEFAULT_AGEING, DEFAULT_J_M, SimulatedDrive, make_settings

    return SimulatedDrive(
        make_settings(
            J_m=DEFAULT_J_M,
            effects=arguments.effect,
            ageing=DEFAULT_AGEING if arguments.ageing is None else arguments.ageing,
            rate_hz=arguments.rate or 1000.0,
            seed=arguments.seed,
        )
    )


def serve(arguments: argparse.Namespace, stop: threading.Event) -> None:
    """Serve it until `stop` is set.

    Raises:
        BadInputError: the link cannot be made, or a flag is of no use here; the text names it.
    """
    from servo_daemon.sim_drive.makes.serve import serve as serve_device

    make = _one_more(arguments)
    if make is not None and _MORE[make][0]:
        from servo_daemon.sim_drive.makes.catalogue import BRUSHED

        serve_device(getattr(arguments, make), BRUSHED[make](brushed_motor(arguments), arguments.drive_id), stop=stop)
        return
    for flag, given in (("--effect", arguments.effect), ("--ageing", arguments.ageing)):
        if given:
            raise BadInputError(f"{flag} is for a brushed motor: this one is brushless, with a controller")
    link, device = _device(arguments)
    serve_device(link, device, stop=stop)


def _device(arguments: argparse.Namespace) -> tuple[Path, Device]:
    make = _one_more(arguments)
    if make is not None:
        from servo_daemon.sim_drive.makes.catalogue import FOC

        return getattr(arguments, make), FOC[make](arguments.seed, arguments.drive_id)
    from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
    from servo_daemon.sim_drive.makes.foc import FocDrive, RunningFoc
    from servo_daemon.sim_drive.makes.odrive import OdriveNode, OdriveText
    from servo_daemon.sim_drive.makes.vesc import VescDevice, VescNode

    motor = RunningFoc(FocDrive(seed=arguments.seed))
    if arguments.vesc:
        return arguments.vesc, VescDevice(motor)
    if arguments.vesc_can:
        rate_hz = arguments.rate or _CAN_HZ
        return arguments.vesc_can, SlcanBus(VescNode(motor, vesc_id=arguments.drive_id, rate_hz=rate_hz))
    if arguments.odrive_text:
        return arguments.odrive_text, OdriveText(motor)
    generation, link = arguments.odrive
    if generation not in ("0.5", "0.6"):
        raise BadInputError(f"--odrive {generation}: the generation is 0.5 or 0.6")
    period_s = 1.0 / (arguments.rate or _ODRIVE_HZ)
    return Path(link), SlcanBus(OdriveNode(motor, generation=generation, node_id=arguments.drive_id, period_s=period_s))
