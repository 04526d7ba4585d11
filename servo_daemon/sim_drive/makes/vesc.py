"""A simulated VESC: packets on a serial line, status messages on CAN. Rates, averages and casts are the firmware's."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from drivers.base import DriverCounters
from drivers.vesc.packets import PacketReader, encode_packet
from drivers.vesc.requests import FORWARD_CAN, FW_VERSION, GET_MCCONF, GET_VALUES, GET_VALUES_SELECTIVE
from drivers.vesc.values import NO_AVERAGE, VALUES
from servo_daemon.sim_drive.makes.foc import FocDrive, RunningFoc, Sums
from servo_daemon.sim_drive.makes.vesc_configuration import packed
from servo_daemon.sim_drive.slcan_adapter import BusFrame

UUID = bytes(range(0x10, 0x1C))
_FIRMWARE = bytes([FW_VERSION, 6, 2]) + b"SIMULATED\0" + UUID + b"\0\0"
_SIGNATURE = 2_509_944_602

#: The averaged fields and the sums behind them.
_AVERAGED = {
    "avg_motor_current_A": "motoring", "avg_id_A": "i_d", "avg_iq_A": "i_q", "avg_vd_V": "v_d", "avg_vq_V": "v_q",
}  # fmt: skip
#: The motor runs on while nobody asks: in steps of so long.
_IDLE_S = 0.02

_INT32 = 1 << 32


def pid_pos_deg(drive: FocDrive, encoder: bool) -> float:
    """The mechanical angle, or without an encoder the electrical one, 0 … 360."""
    turn = drive.theta if encoder else drive.theta * drive.motor.pole_pairs
    return math.degrees(turn % (2.0 * math.pi))


def tachometer(drive: FocDrive) -> int:
    """Six counts an electrical turn."""
    return math.floor(drive.theta * drive.motor.pole_pairs / (math.pi / 3.0))


def duty(drive: FocDrive) -> float:
    """Its size is the voltage vector's, its sign that of vq."""
    size = math.hypot(drive.v_d, drive.v_q) * math.sqrt(3.0) / drive.motor.supply_V
    return math.copysign(size, drive.v_q)


def erpm(drive: FocDrive) -> float:
    return drive.omega * drive.motor.pole_pairs * 60.0 / (2.0 * math.pi)


class VescDevice:
    """A VESC behind a serial line.

    Args:
        encoder: whether `pid_pos` is the shaft's angle.
        can_id: it is reached by forwarding to this id only; None: it is the one on the line.
    """

    period_s: float | None = _IDLE_S

    def __init__(self, motor: RunningFoc, *, encoder: bool = True, can_id: int | None = None) -> None:
        self._motor, self._encoder, self._can_id = motor, encoder, can_id
        self._reader = PacketReader(DriverCounters())
        self._read_at = dict.fromkeys(_AVERAGED, Sums())

    def receive(self, data: bytes) -> bytes:
        return b"".join(map(encode_packet, filter(None, map(self._answer, self._reader.feed(data)))))

    def due(self) -> bytes:
        self._motor.now()
        return b""

    def read_by_another(self) -> None:
        """Another program reads all values: the averages begin anew."""
        self._values((1 << len(VALUES)) - 1)

    def _answer(self, payload: bytes) -> bytes:
        if self._can_id is not None:
            if payload[:2] != bytes([FORWARD_CAN, self._can_id]):
                return b""
            payload = payload[2:]
        if payload == bytes([FW_VERSION]):
            return _FIRMWARE
        if payload == bytes([GET_MCCONF]):
            return payload + packed(_SIGNATURE, self._configuration())
        if payload == bytes([GET_VALUES]):
            return bytes([GET_VALUES]) + self._values((1 << len(VALUES)) - 1)
        if payload[:1] == bytes([GET_VALUES_SELECTIVE]) and len(payload) == 5:
            return payload + self._values(int.from_bytes(payload[1:], "big"))
        return b""

    def _configuration(self) -> dict[str, float]:
        motor = self._motor.now().motor
        told = {"ratio": float(motor.pole_pairs), "sensor_mode": float(self._encoder), "poles": 2.0 * motor.pole_pairs}
        return told | {"L": motor.L, "R": motor.R, "flux": motor.flux}

    def _values(self, mask: int) -> bytes:
        drive = self._motor.now()
        now = {
            "duty": duty(drive),
            "erpm": erpm(drive),
            "v_in_V": drive.motor.supply_V,
            "tachometer": tachometer(drive),
            "pid_pos_deg": pid_pos_deg(drive, self._encoder),
        }
        body = b""
        for bit, value in enumerate(VALUES):
            if not mask >> bit & 1:
                continue
            if value.name in _AVERAGED:
                raw = self._average(drive.sums, value.name, value.steps)
            else:
                raw = int(now.get(value.name, 0.0) * value.steps)  # a cast: toward zero
            body += struct.pack(">" + value.format, bytes(6) if value.format == "6s" else raw)
        return body

    def _average(self, sums: Sums, name: str, steps: float) -> int:
        """Since this field was last read; over no cycle the firmware divides 0 by 0 and casts that."""
        before, self._read_at[name] = self._read_at[name], sums
        n = sums.n - before.n
        total = getattr(sums, _AVERAGED[name]) - getattr(before, _AVERAGED[name])
        return int(total / n * steps) if n else NO_AVERAGE


class VescNode:
    """A VESC's status messages 1, 4 and 5 on CAN, all at one rate."""

    def __init__(self, motor: RunningFoc, *, vesc_id: int = 7, rate_hz: float = 200.0, encoder: bool = True) -> None:
        self._motor, self._id, self._encoder = motor, vesc_id, encoder
        self.period_s: float | None = 1.0 / rate_hz

    def receive(self, frame: BusFrame) -> Sequence[BusFrame]:  # noqa: ARG002
        return ()

    def due(self) -> Sequence[BusFrame]:
        drive = self._motor.now()
        share, motoring = duty(drive), math.copysign(abs(drive.i_q_filtered), drive.v_q * drive.i_q_filtered)
        angle = pid_pos_deg(drive, self._encoder)
        steps = (tachometer(drive) + _INT32 // 2) % _INT32 - _INT32 // 2
        return (
            self._frame(9, struct.pack(">ihh", int(erpm(drive)), int(motoring * 10.0), int(share * 1000.0))),
            self._frame(16, struct.pack(">hhhh", 250, 250, 0, int(angle * 50.0))),
            self._frame(27, struct.pack(">ihh", steps, int(drive.motor.supply_V * 10.0), 0)),
        )

    def _frame(self, command: int, data: bytes) -> BusFrame:
        return BusFrame(command << 8 | self._id, data, extended=True)
