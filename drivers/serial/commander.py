"""A drive on the binary serial wire that is commanded. Made by `servo-daemon commission` alone: the driver that `run`
and all else use is its base, and has no way to send."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np

from drivers.commanding import LONGEST_COMMAND_S
from drivers.serial.command import LAST_NUMBER, Command, encode_command
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.frame import encode_frame
from drivers.serial.line import SerialDriver
from drivers.serial.wire import Description, Quantity
from servo_daemon.errors import DriverConfigError, DriverDisconnectedError, DriverError
from servo_daemon.samples import F64, I64, SampleBlock

#: A delay is forgotten with this time constant, s: one hiccup of the host does not narrow the limits for a whole run.
_FORGET_S = 0.5


class CommandedSerialDriver(SerialDriver):
    """`SerialDriver` with `drivers.commanding.Commanding`.

    Raises:
        DriverConfigError: the text wire carries no commands.
    """

    #: A host without a real-time system is late by some ten milliseconds now and then: as long as any drive holds one.
    hold_s = LONGEST_COMMAND_S
    _spacing_s = 0.0

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        if not isinstance(self._decoder, BinaryDecoder):
            raise DriverConfigError(f'drive {name}: wire = "text" carries no commands')
        self._binary = self._decoder
        self._number = 0
        self._volts = np.full(LAST_NUMBER + 1, math.nan)  # of each number; 0: no command acts
        self._given_s = np.full(LAST_NUMBER + 1, math.nan)  # newest sample known when it was given, device time
        self._newest_s = self._latency_s = 0.0

    @property
    def latency_s(self) -> float:
        return self._latency_s

    def command(self, voltage_V: float, valid_for_s: float) -> None:
        if not (math.isfinite(voltage_V) and valid_for_s > 0.0):
            raise DriverError(f"drive {self.name}: {voltage_V} V for {valid_for_s} s is no command")
        self._number = self._number % LAST_NUMBER + 1
        self._volts[self._number], self._given_s[self._number] = voltage_V, self._newest_s
        self._send_command(voltage_V, valid_for_s, enabled=True)

    def acting_V(self, block: SampleBlock) -> F64:
        numbers = self._numbers_at(block.sequence)
        volts, at = self._volts[numbers], block.time_s
        self._latency_s *= math.exp(-(at[-1] - at[0]) / _FORGET_S)
        changes = np.flatnonzero(np.diff(numbers, prepend=-1))
        delays = (at - self._given_s[numbers])[changes[numbers[changes] > 0]]
        if np.any(np.isfinite(delays)):
            self._latency_s = max(self._latency_s, float(np.nanmax(delays)))
        return volts

    def _read(self, timeout_s: float) -> SampleBlock | None:
        block = super()._read(timeout_s)
        if block is not None:
            self._newest_s = float(block.time_s[-1])
        return block

    def _close(self) -> None:
        with contextlib.suppress(DriverError):  # the port is gone: the drive stops by itself
            self._send_command(0.0, LONGEST_COMMAND_S, enabled=False)
        super()._close()

    def _numbers_at(self, sequence: I64) -> I64:
        """Of the commands that act on these samples of the last block, shape (n,)."""
        if not self._binary.numbers:
            return np.zeros_like(sequence)
        at, numbers = (np.concatenate(columns) for columns in zip(*self._binary.numbers, strict=True))
        self._binary.numbers.clear()
        k = np.minimum(np.searchsorted(at, sequence), len(at) - 1)
        return np.where(at[k] == sequence, numbers[k], 0)

    def _send_command(self, voltage_V: float, valid_for_s: float, *, enabled: bool) -> None:
        told = self._described()
        valid_ms = max(1, math.floor(1e3 * min(valid_for_s, LONGEST_COMMAND_S) + 1e-6))
        command = Command(told.drive_id, told.session, max(self._number, 1), enabled, valid_ms, voltage_V)
        self._send(encode_frame(encode_command(command)))

    def _described(self) -> Description:
        told = self._binary.description
        if told is None:
            raise DriverDisconnectedError(f"drive {self.name}: it has not described itself: nothing can be commanded")
        if told.channel(Quantity.COMMAND) is None:
            raise DriverError(
                f"drive {self.name}: it takes no commands: its samples have no channel for their numbers "
                "(docs/protocol.md, frame type 4)"
            )
        return told
