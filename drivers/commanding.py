"""What a driver offers that can move its motor: a capability of its own, and most drivers lack it on purpose.

Drivers read. One that also commands has `command`; `servo-daemon commission` asks for it, nothing else calls it.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from drivers.base import DriveInfo
from servo_daemon.samples import SampleBlock

#: A command is valid for at most so long, s: a drive that hears nothing for this time stops by itself.
LONGEST_COMMAND_S = 0.05


@runtime_checkable
class Commanding(Protocol):
    """A drive that takes voltages, beside what `drivers.base.Driver` says of reading."""

    @property
    def info(self) -> DriveInfo: ...

    def read(self, timeout_s: float) -> SampleBlock | None: ...

    def command(self, voltage_V: float, valid_for_s: float) -> None:
        """Apply this voltage from the next sample on. After `valid_for_s`, s, without another command, and after
        `LONGEST_COMMAND_S` in any case, the drive goes to 0 V by itself; 0 V stops the motor.

        Raises:
            DriverError: the drive is not open, or the voltage or the time is not a number.
        """
        ...
