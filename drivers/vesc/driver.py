"""Driver "vesc": a VESC that is asked over USB or UART, or listened to on CAN.

    [drive.options]
    port = "/dev/ttyACM0"

or, with status messages switched on in the VESC's app settings,

    [drive.options]
    interface = "socketcan"
    channel = "can0"
"""

from __future__ import annotations

from typing import Any, ClassVar

from drivers.base import Driver
from drivers.vesc.listening import ListenedVesc
from drivers.vesc.polling import PolledVesc


class VescDriver(Driver):
    """A VESC; made for its line by `made`."""

    kind: ClassVar[str] = "vesc"

    @classmethod
    def made(cls, name: str, options: dict[str, Any]) -> Driver:
        return ListenedVesc(name, options) if "interface" in options else PolledVesc(name, options)
