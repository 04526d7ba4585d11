"""Driver "odrive": an ODrive that is listened to on CAN, or asked there (firmware 0.6) or over USB or UART (0.5).

    [drive.options]
    interface = "socketcan"
    channel = "can0"

or

    [drive.options]
    port = "/dev/ttyACM0"

With `endpoints`, the maker's file for firmware 0.6, it is asked on CAN, its voltage as well.
"""

from __future__ import annotations

from typing import Any, ClassVar

from drivers.base import Driver
from drivers.odrive.asking import AskedOdrive
from drivers.odrive.listening import ListenedOdrive
from drivers.odrive.sdo import SdoOdrive


class OdriveDriver(Driver):
    """An ODrive; made for its line by `made`."""

    kind: ClassVar[str] = "odrive"

    @classmethod
    def made(cls, name: str, options: dict[str, Any]) -> Driver:
        if "endpoints" in options:
            return SdoOdrive(name, options)
        return AskedOdrive(name, options) if "port" in options else ListenedOdrive(name, options)
