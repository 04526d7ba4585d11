"""A SimpleFOC sketch that prints its monitor."""

from __future__ import annotations

from servo_daemon.sim_drive.makes.moving import DQ_VOLTAGE, Motor


class SimpleFocMonitor:
    """Lines of `motor.monitor()`.

    Args:
        motor: what turns.
        monitor: the mask in binary, seven digits.
        period_s: from line to line.
    """

    def __init__(self, motor: Motor, *, monitor: str = "1101011", period_s: float = 2e-3) -> None:
        self._motor, self._monitor = motor, monitor
        self.period_s: float | None = period_s

    def receive(self, data: bytes) -> bytes:  # noqa: ARG002
        """Nobody reads what the host says: the sketch has no Commander."""
        return b""

    def due(self) -> bytes:
        """The next line: four decimals, tabs (Arduino-FOC, `FOCMotor::monitor`)."""
        s = self._motor.now()
        values = (0.0, s.voltage_V / DQ_VOLTAGE, 0.0, 1e3 * s.current_A, 0.0, s.velocity_rad_s, s.position_rad)
        chosen = [f"{v:.4f}" for bit, v in zip(self._monitor, values, strict=True) if bit == "1"]
        return "\t".join(chosen).encode() + b"\r\n"
