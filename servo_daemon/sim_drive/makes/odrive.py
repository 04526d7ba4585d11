"""A simulated ODrive: the cyclic messages of CANSimple 0.5 and 0.6, and the text protocol of 0.5."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Literal

from servo_daemon.sim_drive.makes.foc import RunningFoc
from servo_daemon.sim_drive.slcan_adapter import BusFrame

Generation = Literal["0.5", "0.6"]

#: The heartbeat comes every so many bursts: 100 ms at the encoder's default of 10 ms.
_HEARTBEAT_EVERY = 10
_CLOSED_LOOP = 8
_IDLE_S = 0.02


class OdriveNode:
    """One axis on CAN; encoder, Iq (0.5) or Iq and torques (0.6) and bus voltage in every burst, in that order."""

    def __init__(
        self, motor: RunningFoc, *, generation: Generation = "0.6", node_id: int = 0, period_s: float = 0.01
    ) -> None:
        self._motor, self._generation, self._node = motor, generation, node_id
        self.period_s: float | None = period_s
        self._bursts = 0

    def receive(self, frame: BusFrame) -> Sequence[BusFrame]:  # noqa: ARG002
        return ()

    def due(self) -> Sequence[BusFrame]:
        drive = self._motor.now()
        turn = 2.0 * math.pi
        frames = [] if self._bursts % _HEARTBEAT_EVERY else [self._heartbeat()]
        self._bursts += 1
        frames.append(self._frame(0x09, struct.pack("<ff", drive.theta / turn, drive.omega / turn)))
        frames.append(self._frame(0x14, struct.pack("<ff", drive.i_q, drive.i_q_filtered)))
        frames.append(self._frame(0x17, struct.pack("<ff", drive.motor.supply_V, 0.0)))
        if self._generation == "0.6":
            torque = drive.motor.Kt * drive.i_q_filtered
            frames.append(self._frame(0x1C, struct.pack("<ff", torque, torque)))
        return frames

    def _heartbeat(self) -> BusFrame:
        if self._generation == "0.5":
            return self._frame(0x01, struct.pack("<IBBBB", 0, _CLOSED_LOOP, 0, 0, 0x80))
        return self._frame(0x01, struct.pack("<IBBBB", 0, _CLOSED_LOOP, 0, 1, 0))

    def _frame(self, command: int, data: bytes) -> BusFrame:
        return BusFrame(self._node << 5 | command, data)


class OdriveText:
    """Axis 0 on a serial line, firmware 0.5."""

    period_s: float | None = _IDLE_S

    def __init__(self, motor: RunningFoc) -> None:
        self._motor, self._rest = motor, b""

    def receive(self, data: bytes) -> bytes:
        *lines, self._rest = (self._rest + data).split(b"\n")
        return b"".join(self._answer(line.strip()) for line in lines)

    def due(self) -> bytes:
        self._motor.now()
        return b""

    def _answer(self, line: bytes) -> bytes:
        drive, turn = self._motor.now(), 2.0 * math.pi
        if line == b"f 0":
            return b"%f %f\r\n" % (drive.theta / turn, drive.omega / turn)
        if line == b"r axis0.motor.current_control.Iq_measured":
            return b"%f\r\n" % drive.i_q_filtered
        if line == b"r axis0.motor.config.torque_constant":
            return b"%f\r\n" % drive.motor.Kt
        return b"unknown command\r\n"
