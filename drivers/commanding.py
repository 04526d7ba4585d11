"""What a driver offers that can move its motor: a capability of its own, and most drivers lack it on purpose.

Drivers read. What also commands is in `COMMANDING`, and `servo-daemon commission` alone makes it.
"""

from __future__ import annotations

import importlib
from typing import Any, Protocol, cast

from drivers.base import DriveInfo, Driver
from drivers.registry import driver_class
from servo_daemon.samples import F64, SampleBlock

#: A command is valid for at most so long, s: a drive that hears nothing for this time stops by itself.
LONGEST_COMMAND_S = 0.05


#: kind -> (module, class) of what commands. The simulated drive's driver reads and commands; on a wire the driver that
#: everything else uses has no way to send.
COMMANDING: dict[str, tuple[str, str]] = {
    "simulated": ("servo_daemon.simulate.driver", "SimulatedDriver"),
    "serial": ("drivers.serial.commander", "CommandedSerialDriver"),
}


class Commanding(Protocol):
    """A drive that takes voltages, beside what `drivers.base.Driver` says of reading.

    Attributes:
        hold_s: for how long a command should be valid, s: what may pass between two of them on this way to the drive.
    """

    hold_s: float

    @property
    def info(self) -> DriveInfo: ...

    @property
    def can_wait(self) -> bool: ...

    @property
    def latency_s(self) -> float:
        """Longest time lately from the newest sample that was known when a command was given until it acted, s."""
        ...

    def read(self, timeout_s: float) -> SampleBlock | None: ...

    def acting_V(self, block: SampleBlock) -> F64:
        """The commanded voltage that should act at each sample of the block that was read last, shape (n,), V; not a
        number: none does, and the drive stays at 0 V until it is told 0 V."""
        ...

    def command(self, voltage_V: float, valid_for_s: float) -> None:
        """Apply this voltage from the next sample on. After `valid_for_s`, s, without another command, and after
        `LONGEST_COMMAND_S` in any case, the drive goes to 0 V by itself; 0 V stops the motor.

        Raises:
            DriverError: the drive is not open, or the voltage or the time is not a number.
        """
        ...


def make_commanding(kind: str, name: str, options: dict[str, Any]) -> tuple[Driver, Commanding] | None:
    """A closed driver by both of its sides: what is opened and closed, and what commands. None: this kind only reads.

    Raises:
        DriverConfigError: unknown driver, or wrong options.
    """
    if kind not in COMMANDING:
        driver_class(kind)  # an unknown one is said to be unknown
        return None
    module, cls = COMMANDING[kind]
    driver = getattr(importlib.import_module(module), cls).made(name, options)
    return driver, cast(Commanding, driver)
