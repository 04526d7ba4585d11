"""A CANopen node with the profile CiA 402: a PDO by time or by SYNC, and expedited SDO uploads."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from servo_daemon.sim_drive.makes.moving import Motor, Shown
from servo_daemon.sim_drive.slcan_adapter import BusFrame

_SYNC, _PDO1, _SDO_ANSWER, _SDO_REQUEST, _HEARTBEAT = 0x80, 0x180, 0x580, 0x600, 0x700
#: A heartbeat with the state "operational" comes with every so many PDOs.
_OPERATIONAL, _PDOS_A_BEAT = b"\x05", 100
#: Switched on, operation enabled (CiA 402-2, statusword).
_ENABLED = 0x0637
_DEVICE_TYPE = 0x0002_0192  # a servo drive with the profile 402
_NO_SUCH_OBJECT = 0x0602_0000


class Cia402Node:
    """The drive.

    Args:
        motor: what turns; its voltage is Uq of an AX8000 (object 0x3242:0F), its current that of 0x6078.
        torque_per_ampere: N·m/A.
        rated_current_A, rated_torque_Nm: what 1000 ‰ are.
        period_s: of PDO 1 by time; None: at each SYNC.
    """

    def __init__(
        self,
        motor: Motor,
        *,
        torque_per_ampere: float,
        node_id: int = 1,
        counts_per_rev: int = 8192,
        rated_current_A: float = 5.0,
        rated_torque_Nm: float = 2.0,
        period_s: float | None = 2e-3,
    ) -> None:
        self._motor, self._torque_per_ampere, self._node_id = motor, torque_per_ampere, node_id
        self._counts_per_rev = counts_per_rev
        self._rated_current_A, self._rated_torque_Nm = rated_current_A, rated_torque_Nm
        self.period_s = period_s
        self._pdos = 0
        self._shown: Shown | None = None  # of the round of uploads that has begun

    def due(self) -> Sequence[BusFrame]:
        """PDO 1: statusword, position, torque; now and then the heartbeat before it."""
        beat = (BusFrame(_HEARTBEAT + self._node_id, _OPERATIONAL),) if self._pdos % _PDOS_A_BEAT == 0 else ()
        self._pdos += 1
        s = self._motor.now()
        data = struct.pack("<H", _ENABLED) + self._position(s) + self._torque(s)
        return (*beat, BusFrame(_PDO1 + self._node_id, data))

    def receive(self, frame: BusFrame) -> Sequence[BusFrame]:
        """The PDO at SYNC, the answer to an SDO upload."""
        if frame.frame_id == _SYNC and self.period_s is None:
            return self.due()
        if frame.frame_id != _SDO_REQUEST + self._node_id or len(frame.data) != 8 or frame.data[0] != 0x40:
            return ()
        index, sub = struct.unpack_from("<HB", frame.data, 1)
        return (BusFrame(_SDO_ANSWER + self._node_id, self._upload(index, sub)),)

    def _upload(self, index: int, sub: int) -> bytes:
        """Position begins a round: the motor moves on with it and all of the round is of one instant."""
        if (index, sub) == (0x6064, 0):
            self._shown = self._motor.now()
            value = self._position(self._shown)
        else:
            s = self._shown or self._motor.now()
            values = {
                (0x1000, 0): struct.pack("<I", _DEVICE_TYPE),
                (0x6075, 0): struct.pack("<I", round(1e3 * self._rated_current_A)),
                (0x6076, 0): struct.pack("<I", round(1e3 * self._rated_torque_Nm)),
                (0x608F, 1): struct.pack("<I", self._counts_per_rev),
                (0x608F, 2): struct.pack("<I", 1),
                (0x6077, 0): self._torque(s),
                (0x6078, 0): _short(1e3 * s.current_A / self._rated_current_A),
                (0x606C, 0): struct.pack("<i", round(1e3 * s.velocity_rad_s)),
                (0x3242, 0x0F): struct.pack("<f", s.voltage_V),
            }
            value = values.get((index, sub), b"")
        head = struct.pack("<HB", index, sub)
        if not value:
            return b"\x80" + head + struct.pack("<I", _NO_SUCH_OBJECT)
        return bytes([0x43 | (4 - len(value)) << 2]) + head + value.ljust(4, b"\0")

    def _position(self, s: Shown) -> bytes:
        counts = round(s.position_rad * self._counts_per_rev / math.tau)
        return struct.pack("<I", counts & 0xFFFF_FFFF)

    def _torque(self, s: Shown) -> bytes:
        return _short(1e3 * self._torque_per_ampere * s.current_A / self._rated_torque_Nm)


def _short(value: float) -> bytes:
    return struct.pack("<h", max(-32768, min(32767, round(value))))
