"""A moteus behind an fdcanusb adapter: answers the register reads it is asked for (docs/protocol/can.md of moteus)."""

from __future__ import annotations

import math
import struct
import time

from drivers.moteus.fdcanusb import checksum, unchecked
from servo_daemon.sim_drive.makes.moving import DQ_VOLTAGE, Motor

#: Registers: those of a state as floats, the counter of milliseconds, and what does not change here.
_MODE, _POSITION, _VELOCITY, _TORQUE, _Q, _D, _POWER, _VOLTAGE, _TEMPERATURE, _FAULT = 0, 1, 2, 3, 4, 5, 7, 13, 14, 15
_COUNTER = 0x70
_RUNNING, _BUS_V, _CELSIUS = 10.0, 24.0, 31.0
#: A register that does not exist is answered by nothing; codes: read and reply, by type.
_READ, _REPLY = 0x10, 0x20
_TYPES = {0: "<b", 1: "<h", 2: "<i", 3: "<f"}
_NOP = 0x50
#: Of the diagnostic channel: subframes, and the layout of `servo_control` (types 16 object, 7 float, 0 end).
_CLIENT_DATA, _SERVER_DATA, _POLL = 0x40, 0x41, 0x42
_TELEMETRY = b"servo_control"


def _field(name: str, kind: bytes) -> bytes:
    return bytes([0, len(name)]) + name.encode() + b"\x00" + kind + b"\x00"


def _object(**fields: bytes) -> bytes:
    return b"\x10\x00" + b"".join(_field(n, k) for n, k in fields.items()) + _field("", b"\x00")


_FLOAT = b"\x07"
_PHASES = _object(a=_FLOAT, b=_FLOAT, c=_FLOAT)
_SCHEMA = _object(pwm=_PHASES, voltage=_PHASES, d_V=_FLOAT, q_V=_FLOAT, i_d_A=_FLOAT, i_q_A=_FLOAT, torque_Nm=_FLOAT)
_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)


class Moteus:
    """The drive: a frame in, its answer out.

    Args:
        motor: what turns; its current is the q current, its K the drive's torque constant (`kt`).
        torque_constant: N·m/A.
        drive_id: 1 .. 126.
    """

    def __init__(self, motor: Motor, *, torque_constant: float, drive_id: int = 1) -> None:
        self._motor, self._torque_constant, self._drive_id = motor, torque_constant, drive_id
        self._start_s = time.monotonic()
        self._heard = self._to_say = b""  # of the diagnostic channel

    def answer(self, frame_id: int, data: bytes) -> tuple[int, bytes] | None:
        """Identifier and data of the answer; None: not for this drive, or none asked for."""
        if frame_id & 0x7F != self._drive_id:
            return None
        registers = self._registers()
        reply, at = bytearray(), 0
        while at < len(data):
            code = data[at]
            at += 1
            if code == _CLIENT_DATA:
                end = at + 2 + data[at + 1]
                self._hear(data[at + 2 : end])
                at = end
            elif code == _POLL:
                channel, most = data[at : at + 2]
                part, self._to_say = self._to_say[:most], self._to_say[most:]
                reply += bytes([_SERVER_DATA, channel, len(part)]) + part
                at += 2
            if code & 0xF0 != _READ:
                continue
            kind, count = code >> 2 & 3, code & 3
            if not count:
                count, at = data[at], at + 1
            first, at = data[at], at + 1
            reply += self._subframe(kind, first, count, registers)
        return (self._drive_id << 8 | frame_id >> 8 & 0x7F, bytes(reply)) if frame_id & 0x8000 else None

    def _hear(self, text: bytes) -> None:
        """Lines of the diagnostic channel."""
        *lines, self._heard = (self._heard + text).split(b"\n")
        for line in lines:
            words = line.split()
            if words == [b"tel", b"schema", _TELEMETRY]:
                self._to_say += b"schema " + _TELEMETRY + b"\r\n" + struct.pack("<I", len(_SCHEMA)) + _SCHEMA
            elif words == [b"tel", b"get", _TELEMETRY]:
                s = self._motor.now()
                values = struct.pack("<6f5f", *[0.5] * 3, *[12.0] * 3, 0.0, s.voltage_V / DQ_VOLTAGE, 0.0, 0.0, 0.0)
                self._to_say += b"emit " + _TELEMETRY + b"\r\n" + struct.pack("<I", len(values)) + values
            else:
                self._to_say += b"OK\r\n" if words[:2] == [b"tel", b"fmt"] else b"ERR unknown command\r\n"

    def _subframe(self, kind: int, first: int, count: int, registers: dict[int, float]) -> bytes:
        head = bytes([_REPLY | kind << 2 | count]) if count < 4 else bytes([_REPLY | kind << 2, count])
        values = (registers[first + k] for k in range(count))
        packed = (struct.pack(_TYPES[kind], v if kind == 3 else int(v)) for v in values)
        return head + bytes([first]) + b"".join(packed)

    def _registers(self) -> dict[int, float]:
        s = self._motor.now()
        power = s.voltage_V * s.current_A  # 1.5 vq iq with vq = v / 1.5
        counter = int(1e3 * (time.monotonic() - self._start_s)) & 0x7FFF_FFFF
        return {
            _MODE: _RUNNING, _POSITION: s.position_rad / math.tau, _VELOCITY: s.velocity_rad_s / math.tau,
            _TORQUE: self._torque_constant * s.current_A, _Q: s.current_A, _D: 0.0, _POWER: power,
            _VOLTAGE: _BUS_V, _TEMPERATURE: _CELSIUS, _FAULT: 0.0, _COUNTER: float(counter),
        }  # fmt: skip


class Fdcanusb:
    """The adapter, with one drive on its bus."""

    period_s: float | None = None

    def __init__(self, drive: Moteus) -> None:
        self._drive = drive
        self._line = b""

    def receive(self, data: bytes) -> bytes:
        """`OK` to every line that sends a frame, and the drive's answer; `ERR` to any other."""
        *lines, self._line = (self._line + data).split(b"\n")
        return b"".join(self._checked(line) for line in lines if line.strip())

    def due(self) -> bytes:
        """Bytes to send unasked: none."""
        return b""

    def _checked(self, line: bytes) -> bytes:
        """The answer, with checksums to a line that has one."""
        text = unchecked(line)
        if text is None:
            return b"ERR checksum\r\n"
        answer = self._answer(text.split())
        if text == line:
            return answer
        checked = (part + b" *%02X\r\n" % checksum(part + b" ") for part in answer.split(b"\r\n") if part)
        return b"".join(checked)

    def _answer(self, words: list[bytes]) -> bytes:
        if words[:2] != [b"can", b"send"] or len(words) < 4:
            return b"ERR unknown command\r\n"
        answer = self._drive.answer(int(words[2], 16), bytes.fromhex(words[3].decode()))
        if answer is None:
            return b"OK\r\n"
        frame_id, data = answer
        full = data.ljust(next(n for n in _LENGTHS if n >= len(data)), bytes([_NOP]))
        return b"OK\r\nrcv %x %s E B F\r\n" % (frame_id, full.hex().encode())
