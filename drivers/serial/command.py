"""Commands to a drive: frame type 4 of the binary wire (docs/protocol.md). The only bytes that are ever sent on it."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from drivers.serial.wire import FrameType
from servo_daemon.errors import WireError

#: Raised when a command's layout changes (docs/protocol.md).
COMMAND_VERSION = 1
#: Numbers of commands go from 1 to this and on with 1; 0 in a sample says that none acts.
LAST_NUMBER = 0xFFFF
#: Anything else in its place stops the motor: no single bit, and no line that is stuck, turns it on.
ENABLE = 0xA5

# type, drive id, session, version, number, enable, valid for in ms, V
_LAYOUT = struct.Struct("<BBBBHBBf")


@dataclass(frozen=True, slots=True)
class Command:
    """One command.

    Attributes:
        drive_id, session: of the description it answers.
        number: 1 .. LAST_NUMBER, one more than the last.
        enabled: false: 0 V at once.
        valid_ms: from its arrival, 1 .. 255; no drive holds one for more than 50.
    """

    drive_id: int
    session: int
    number: int
    enabled: bool
    valid_ms: int
    voltage_V: float


def encode_command(command: Command) -> bytes:
    """Payload of a command frame.

    Raises:
        ValueError: a field does not fit.
    """
    if not (1 <= command.number <= LAST_NUMBER and math.isfinite(command.voltage_V)):
        raise ValueError(f"no command: {command}")
    try:
        return _LAYOUT.pack(
            FrameType.COMMAND, command.drive_id, command.session, COMMAND_VERSION, command.number,
            ENABLE if command.enabled else 0, command.valid_ms, command.voltage_V,
        )  # fmt: skip
    except (struct.error, OverflowError) as error:
        raise ValueError(f"{command} does not fit the wire: {error}") from error


def decode_command(payload: bytes) -> Command:
    """The command in a payload (without CRC).

    Raises:
        WireError: it is none, or of another version.
    """
    if len(payload) != _LAYOUT.size:
        raise WireError(f"{len(payload)} bytes are no command")
    kind, drive_id, session, version, number, enable, valid_ms, voltage = _LAYOUT.unpack(payload)
    if kind != FrameType.COMMAND or version != COMMAND_VERSION or number == 0:
        raise WireError(f"frame type {kind}, version {version}, number {number}: no command of version 1")
    return Command(drive_id, session, number, enable == ENABLE, valid_ms, voltage)
