"""What a drive's firmware makes of commands (docs/protocol.md, frame type 4), on the drive's own clock."""

from __future__ import annotations

import logging
import math

import numpy as np

from drivers.commanding import LONGEST_COMMAND_S
from drivers.serial.command import Command, decode_command
from drivers.serial.frame import DELIMITER, MAX_ENCODED, decode_frame
from drivers.serial.wire import Description
from servo_daemon.errors import WireError
from servo_daemon.samples import F64, I64

log = logging.getLogger(__name__)

#: A number is newer than the last if it is ahead of it by less than half of all.
_HALF = 0x8000


class CommandedOutput:
    """The voltage at the motor, sample by sample: 0 V unless a command acts.

    Args:
        description: of this drive; commands to another drive or session are not for it.
        rate_hz: of its samples, which are its clock.
        most_V: greatest voltage it can apply; what asks for more is no command.
    """

    def __init__(self, description: Description, rate_hz: float, most_V: float) -> None:
        self.description = description
        self._rate_hz, self._most_V = rate_hz, most_V
        self._carry = b""
        self._taken = 0  # samples so far
        self._number, self._voltage_V = 0, 0.0  # of the command that acts; 0: none
        self._until = 0  # the first sample on which it does not act any more

    def hear(self, data: bytes) -> int:
        """Takes bytes from the line; how many commands were followed."""
        *frames, self._carry = (self._carry + data).split(DELIMITER)
        self._carry = self._carry[-MAX_ENCODED:]
        followed = 0
        for encoded in filter(None, frames):
            try:
                followed += self._follow(decode_command(decode_frame(encoded)))
            except WireError:
                continue  # noise, or a frame for somebody else
        return followed

    def next(self, n: int) -> tuple[F64, I64]:
        """Voltages and numbers of the commands that act, each of shape (n,), of the next n samples."""
        acts = np.arange(self._taken, self._taken + n) < self._until
        self._taken += n
        voltage = np.where(acts, self._voltage_V, 0.0)
        numbers = np.where(acts, self._number, 0)
        if self._number and self._taken >= self._until:
            log.info("no command for %.0f ms: 0 V", 1e3 * LONGEST_COMMAND_S)
            self._number = 0
        return voltage, numbers

    def _follow(self, c: Command) -> bool:
        told = self.description
        if (c.drive_id, c.session) != (told.drive_id, told.session):
            return False
        if not c.enabled or not math.isfinite(c.voltage_V) or abs(c.voltage_V) > self._most_V:
            self._number = self._until = 0
            return c.enabled is False
        if self._number:
            if not 0 < (c.number - self._number) % (2 * _HALF) < _HALF:
                return False  # an old one again
        elif c.voltage_V != 0.0:
            return False  # from standstill it is 0 V first: whoever was interrupted begins anew
        self._number, self._voltage_V = c.number, c.voltage_V
        self._until = self._taken + math.floor(min(c.valid_ms / 1e3, LONGEST_COMMAND_S) * self._rate_hz + 1e-6)
        return True
