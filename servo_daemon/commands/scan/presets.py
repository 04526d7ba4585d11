"""What a drive on a serial port has as its own values of the motor, read once."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from drivers.base import DriverCounters
from drivers.odrive.asking import TORQUE_CONSTANT
from drivers.polling.link import SerialLink
from drivers.serial.port import open_port
from drivers.vesc.configuration import decode_configuration
from drivers.vesc.packets import PacketReader
from drivers.vesc.requests import GET_MCCONF, request
from servo_daemon.commands.scan.asking import within
from servo_daemon.errors import DriverDisconnectedError, WireError

#: For an answer of half a kilobyte at 9600 Bd, on a busy host.
_PATIENCE_S = 2.0


@dataclass(frozen=True, slots=True)
class Preset:
    """Nominal values by parameter, options of the driver, and what there is to say of them."""

    nominal: dict[str, float] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    remark: str | None = None


def preset_of(driver: str, options: Mapping[str, Any]) -> Preset:
    """The values of a drive that has just answered its driver with these options; nothing where it tells none.

    Raises:
        DriverError: its port cannot be opened any more, or went away.
    """
    ask = {"vesc": _vesc, "odrive": _odrive}.get(driver)
    if ask is None or "port" not in options:
        return Preset()
    link = SerialLink(open_port("scan", options["port"], options.get("baudrate", 115200)))
    try:
        return ask(link, options)
    except OSError as error:
        raise DriverDisconnectedError(f"drive scan: device went away: {error}") from error
    finally:
        link.close()


def _vesc(link: SerialLink, options: Mapping[str, Any]) -> Preset:
    """Its motor configuration. Pole pairs become an option only where they are needed: without an encoder."""
    link.send(request(bytes([GET_MCCONF]), options.get("can_id")))
    reader = PacketReader(DriverCounters())
    for data in within(link, _PATIENCE_S):
        for payload in reader.feed(data):
            if payload[0] == GET_MCCONF:
                try:
                    motor = decode_configuration(payload)
                except WireError as error:
                    return Preset(remark=f"its own values of R, L and K are not read: {error}")
                pairs = {"pole_pairs": motor.pole_pairs} if options.get("position") == "electrical" else {}
                remark = f"nominal values are the drive's own, with {motor.pole_pairs} pole pairs: check their number"
                return Preset(motor.nominal(), pairs if motor.pole_pairs else {}, remark)
    return Preset()


def _odrive(link: SerialLink, options: Mapping[str, Any]) -> Preset:
    """Its torque constant, which is K of the current that it reports. Its answers have no names, and one to a question
    of before may still come: so it is asked twice, and the same number twice in a row is the answer."""
    link.send(TORQUE_CONSTANT[options.get("axis", 0)] * 2)
    text = b""
    for data in within(link, _PATIENCE_S):
        text += data
        lines = [line.strip() for line in text.split(b"\n")[:-1]]
        for line in (first for first, second in pairwise(lines) if first == second):
            with contextlib.suppress(ValueError):
                value = float(line)
                if math.isfinite(value) and value > 0.0:
                    return Preset({"K": value}, remark="K is the drive's own torque constant")
    return Preset()
