"""An MIT mode actuator whose controller commands it all the time: its feedback frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

from servo_daemon.sim_drive.makes.moving import Motor
from servo_daemon.sim_drive.slcan_adapter import BusFrame

#: What the actuator takes the temperature of its MOSFETs for.
_CELSIUS = 30


class MitActuator:
    """Feedback in the layout of CubeMars' AK series.

    Args:
        motor: what turns.
        limits: ±rad, ±rad/s, ±N·m of the model.
        torque_per_ampere: what the drive takes its motor's torque constant for, N·m/A.
        motor_id, reply_id: in the first byte, and the frames' identifier.
        period_s: from command to command.
    """

    def __init__(
        self,
        motor: Motor,
        *,
        limits: tuple[float, float, float] = (12.5, 50.0, 18.0),
        torque_per_ampere: float,
        motor_id: int = 1,
        reply_id: int = 0,
        period_s: float = 2e-3,
    ) -> None:
        self._motor, self._limits, self._torque_per_ampere = motor, limits, torque_per_ampere
        self._motor_id, self._reply_id = motor_id, reply_id
        self.period_s: float | None = period_s

    def receive(self, frame: BusFrame) -> Sequence[BusFrame]:  # noqa: ARG002
        """It obeys its own controller only."""
        return ()

    def due(self) -> Sequence[BusFrame]:
        """The next feedback frame: as position, that within ±limit (it starts anew there), codes cut off as the
        maker's firmware does (a share of all codes, toward zero)."""
        shown, (most_rad, most_rad_s, most_Nm) = self._motor.now(), self._limits
        turned = (shown.position_rad + most_rad) % (2.0 * most_rad) - most_rad
        position = _code(turned, most_rad, 16)
        speed = _code(shown.velocity_rad_s, most_rad_s, 12)
        torque = _code(self._torque_per_ampere * shown.current_A, most_Nm, 12)
        word = self._motor_id << 56 | position << 40 | speed << 28 | torque << 16 | _CELSIUS << 8
        return (BusFrame(self._reply_id, word.to_bytes(8, "big")),)


def _code(value: float, limit: float, bits: int) -> int:
    top = (1 << bits) - 1
    return min(top, max(0, math.floor((value + limit) * top / (2.0 * limit))))
