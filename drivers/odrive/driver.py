"""Driver "odrive": an ODrive that is listened to on CAN, or asked over USB or UART (firmware 0.5).

    [drive.options]
    interface = "socketcan"
    channel = "can0"

or

    [drive.options]
    port = "/dev/ttyACM0"
"""

from __future__ import annotations

from typing import Any, ClassVar

from drivers.base import Driver
from drivers.odrive.asking import AskedOdrive
from drivers.odrive.listening import ListenedOdrive


class OdriveDriver(Driver):
    """An ODrive; made for its line by `made`."""

    kind: ClassVar[str] = "odrive"

    @classmethod
    def made(cls, name: str, options: dict[str, Any]) -> Driver:
        return AskedOdrive(name, options) if "port" in options else ListenedOdrive(name, options)
