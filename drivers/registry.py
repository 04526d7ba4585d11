"""Which drivers exist: a lazy table of the built-in ones and the entry points of third parties.

Nothing is imported before it is asked for, and one broken plugin warns while the rest load.
"""

from __future__ import annotations

import importlib
import logging
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from drivers.base import Driver
from servo_daemon.errors import DriverConfigError

log = logging.getLogger(__name__)

ENTRY_POINT_GROUP = "servo_daemon.drivers"

#: kind -> (module, class)
BUILT_IN: dict[str, tuple[str, str]] = {
    "simulated": ("servo_daemon.simulate.driver", "SimulatedDriver"),
    "serial": ("drivers.serial.line", "SerialDriver"),
    "can": ("drivers.can.bus", "CanDriver"),
    "vesc": ("drivers.vesc.driver", "VescDriver"),
    "odrive": ("drivers.odrive.driver", "OdriveDriver"),
    "replay": ("servo_daemon.captures.driver", "ReplayDriver"),
    "cia402": ("drivers.cia402.drive", "Cia402Driver"),
    "dynamixel": ("drivers.servo_bus.drive", "DynamixelDriver"),
    "feetech": ("drivers.servo_bus.drive", "FeetechDriver"),
    "mit": ("drivers.mit", "MitDriver"),
    "moteus": ("drivers.moteus.drive", "MoteusDriver"),
    "simplefoc": ("drivers.simplefoc", "SimpleFocDriver"),
}


def _plugins() -> dict[str, EntryPoint]:
    return {e.name: e for e in entry_points(group=ENTRY_POINT_GROUP)}


def available() -> tuple[str, ...]:
    """Names usable as `driver = "..."`, built-in first."""
    return (*BUILT_IN, *sorted(set(_plugins()) - set(BUILT_IN)))


def driver_class(kind: str) -> type[Driver]:
    """The class behind a name.

    Raises:
        DriverConfigError: no such driver, or its module cannot be imported.
    """
    try:
        if kind in BUILT_IN:
            module, name = BUILT_IN[kind]
            cls = getattr(importlib.import_module(module), name)
        else:
            plugins = _plugins()
            if kind not in plugins:
                raise DriverConfigError(f"unknown driver {kind!r}: available are {', '.join(available())}")
            cls = plugins[kind].load()
    except (ImportError, AttributeError) as error:
        raise DriverConfigError(f"driver {kind!r} cannot be loaded: {error}") from error
    if not (isinstance(cls, type) and issubclass(cls, Driver)):
        raise DriverConfigError(f"driver {kind!r}: {cls!r} is not a subclass of drivers.base.Driver")
    return cls


def make_driver(kind: str, name: str, options: dict[str, Any]) -> Driver:
    """A closed driver object, its options checked.

    Raises:
        DriverConfigError: unknown driver, or wrong options.
    """
    try:
        cls = driver_class(kind)
    except DriverConfigError as error:
        raise DriverConfigError(f"drive {name}: {error}") from error
    return cls.made(name, options)
