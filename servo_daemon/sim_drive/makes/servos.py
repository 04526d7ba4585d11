"""Servos in a chain: Dynamixel X and Feetech STS, which answer reads of their registers."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

from servo_daemon.sim_drive.makes.moving import Motor, Shown

#: What a chain is supplied with, V, and how warm a servo is.
SUPPLY_V, _CELSIUS = 12.0, 35
_FIRMWARE = 45
#: The models' numbers: XM430-W350, a step of whose Present Current is this, A; STS3215.
_XM430, _XM430_LSB_A, _STS3215 = 1020, 2.69e-3, 777
_COUNTS_PER_RAD = 4096 / (2.0 * math.pi)


def crc16(data: bytes) -> int:
    """CRC-16, polynomial 0x8005 (e-manual, "CRC Calculation"), bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def _cut(value: float, bits: int) -> int:
    most = (1 << bits - 1) - 1
    return max(-most, min(most, round(value)))


class DynamixelChain:
    """Servos of the X series.

    Args:
        motors: by id; their motor's voltage, current and the output shaft's motion.
    """

    period_s: float | None = None

    def __init__(self, motors: Mapping[int, Motor]) -> None:
        self._motors = dict(motors)
        self._buffer = b""

    def due(self) -> bytes:
        """They never speak unasked."""
        return b""

    def receive(self, data: bytes) -> bytes:
        """The answers to the requests that these bytes complete."""
        self._buffer += data
        answers = b""
        while (at := self._buffer.find(b"\xff\xff\xfd\x00")) >= 0 and len(self._buffer) >= at + 7:
            end = at + 7 + int.from_bytes(self._buffer[at + 5 : at + 7], "little")
            if len(self._buffer) < end:
                break
            request, self._buffer = self._buffer[at:end], self._buffer[end:]
            if crc16(request[:-2]) == int.from_bytes(request[-2:], "little"):
                answers += self._answer(request[4], request[7], request[8:-2])
        return answers

    def _answer(self, servo: int, instruction: int, parameters: bytes) -> bytes:
        if instruction == 0x01:
            asked = [servo] if servo in self._motors else list(self._motors) if servo == 0xFE else []
            return b"".join(self._status(s, struct.pack("<HB", _XM430, _FIRMWARE)) for s in asked)
        address, length = struct.unpack_from("<HH", parameters)
        if instruction == 0x02 and servo in self._motors:
            return self._status(servo, self._registers(servo, address, length))
        asked = [s for s in parameters[4:] if s in self._motors]
        if instruction == 0x82:
            return b"".join(self._status(s, self._registers(s, address, length)) for s in asked)
        if instruction == 0x8A and len(asked) == len(parameters) - 4:
            return self._together(asked, address, length)
        return b""

    def _status(self, servo: int, data: bytes) -> bytes:
        body = (b"\x55\x00" + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        head = b"\xff\xff\xfd\x00" + struct.pack("<BH", servo, len(body) + 2) + body
        return head + struct.pack("<H", crc16(head))

    def _together(self, servos: list[int], address: int, length: int) -> bytes:
        """One packet: every servo adds its error, id, data and the CRC so far."""
        size = 1 + len(servos) * (length + 4)
        answer = b"\xff\xff\xfd\x00\xfe" + struct.pack("<HB", size, 0x55)
        for servo in servos:
            answer += bytes([0, servo]) + self._registers(servo, address, length)
            answer += struct.pack("<H", crc16(answer))
        return answer

    def _registers(self, servo: int, address: int, length: int) -> bytes:
        if (address, length) == (0, 2):
            return struct.pack("<H", _XM430)
        s = self._motors[servo].now()
        pwm, velocity = _cut(885 * s.voltage_V / SUPPLY_V, 16), s.velocity_rad_s * 60.0 / math.tau / 0.229
        return struct.pack(
            "<hhii8xHB",
            pwm,
            _cut(s.current_A / _XM430_LSB_A, 16),
            _cut(velocity, 32),
            _cut(s.position_rad * _COUNTS_PER_RAD, 32),
            round(10 * SUPPLY_V),
            _CELSIUS,
        )[:length]


class FeetechChain:
    """Servos of the STS series; as `DynamixelChain`."""

    period_s: float | None = None

    def __init__(self, motors: Mapping[int, Motor]) -> None:
        self._motors = dict(motors)
        self._buffer = b""

    def due(self) -> bytes:
        """They never speak unasked."""
        return b""

    def receive(self, data: bytes) -> bytes:
        """The answers to the requests that these bytes complete."""
        self._buffer += data
        answers = b""
        while (at := self._buffer.find(b"\xff\xff")) >= 0 and len(self._buffer) >= at + 4:
            end = at + 4 + self._buffer[at + 3]
            if len(self._buffer) < end:
                break
            body, self._buffer = self._buffer[at + 2 : end], self._buffer[end:]
            if sum(body) & 0xFF == 0xFF:
                servo, instruction, address, length = body[0], body[2], body[3], body[4]
                asked = [servo] if instruction == 0x02 else list(body[5:-1])
                answers += b"".join(self._status(s, address, length) for s in asked if s in self._motors)
        return answers

    def _status(self, servo: int, address: int, length: int) -> bytes:
        if (address, length) == (3, 3):
            data = struct.pack("<HB", _STS3215, servo)
        else:
            data = self._state(self._motors[servo].now())[:length]
        body = bytes([servo, len(data) + 2, 0]) + data
        return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])

    def _state(self, s: Shown) -> bytes:
        def signed(value: float, bit: int) -> int:
            return abs(round(value)) | (1 << bit if value < 0 else 0)

        return struct.pack(
            "<HHHBB5xH",
            round(s.position_rad * _COUNTS_PER_RAD) % 4096,
            signed(s.velocity_rad_s * _COUNTS_PER_RAD, 15),
            signed(1000 * s.voltage_V / SUPPLY_V, 10),
            round(10 * SUPPLY_V),
            _CELSIUS,
            signed(s.current_A / 6.5e-3, 15),
        )
