"""Driver "simplefoc": the monitor of an Arduino-FOC sketch (`motor.monitor()`), listened to.

A line has what the mask `monitor_variables` of the sketch asks for, tab-separated, without time and names, in the
order of the mask's bits (Arduino-FOC, `FOCMotor.h`, `FOCMotor::monitor`). Voltage and current are the q axis's of one
instant, amplitude-invariant; the current is in mA. Nothing is ever sent: the sketch's settings stay as they are.

    [drive.options]
    port = "/dev/ttyACM0"
    monitor = "1101011"          # target, Uq, Iq, velocity, angle; as printed: motor.monitor_variables in binary
    pole_pairs = 7
"""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, Field, model_validator

from drivers.base import DriveInfo
from drivers.options import STRICT, checked
from drivers.serial.arrival import ArrivalClock
from drivers.serial.listener import SerialListener
from drivers.serial.text import TextDecoder
from drivers.serial.text_format import TextFormat
from servo_daemon.column_names import Meaning
from servo_daemon.samples import SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

#: What may leave the port: nothing.
MAY_SEND: frozenset[bytes] = frozenset()

#: The mask's bits from the highest on: name as in the monitor's documentation, and what it means here.
_COLUMNS: tuple[tuple[str, Meaning | None], ...] = (
    ("target", None),
    ("Uq_V", Meaning("voltage_V")),
    ("Ud_V", None),
    ("Iq_mA", Meaning("current_A", 1e-3)),
    ("Id_mA", None),
    ("vel_rad/s", Meaning("velocity_rad_s")),
    ("angle_rad", Meaning("position_rad")),
)
#: The monitor prints four decimals (`Print::print(value, 4)`).
_DECIMALS = 1e-4


class SimpleFocOptions(BaseModel):
    """`[drive.options]` of `driver = "simplefoc"`.

    `monitor` is the mask in binary. The default is what the sketch needs to say: target, Uq, Iq, velocity and angle;
    Arduino-FOC's own default, "1100011", has no current. `period_s` is the time between lines, where it is known
    (`monitor_downsample` times the time of a turn of `loop`); else it is measured.
    """

    model_config = STRICT

    port: str = Field(min_length=1)
    baudrate: int = Field(115200, gt=0)
    monitor: str = Field("1101011", pattern="^[01]{7}$")
    period_s: float | None = Field(None, gt=0, le=1.0)
    pole_pairs: int = Field(1, ge=1)

    @model_validator(mode="after")
    def _tells_a_motion(self) -> SimpleFocOptions:
        there = set(self.format.channels)
        if not there & {"position_rad", "velocity_rad_s"} or len(there) < 2:
            raise ValueError("'monitor' needs velocity or angle (the last two bits), and Uq or Iq beside it")
        return self

    @property
    def format(self) -> TextFormat:
        """The columns of a line."""
        chosen = [column for bit, column in zip(self.monitor, _COLUMNS, strict=True) if bit == "1"]
        return TextFormat(tuple(name for name, _ in chosen), tuple(meaning for _, meaning in chosen))


class MonitorDecoder:
    """Lines of the monitor to samples. Any bytes may come in; nothing is raised."""

    def __init__(self, lines: TextDecoder, clock: ArrivalClock) -> None:
        self.lines, self.clock = lines, clock

    @property
    def has_ready(self) -> bool:
        return False

    def reattach(self) -> None:
        self.lines.reattach()
        self.clock.reattach()

    def feed(self, data: bytes, host_time_s: float = 0.0) -> SampleBlock | None:
        """The samples that these bytes complete; the first ones come once the time between lines is known."""
        block = self.lines.feed(data, host_time_s)
        if block is None:
            return None
        lost = self.clock.lost
        dated = self.clock.date(block)
        self.lines.counters.samples_lost += self.clock.lost - lost
        return dated


class SimpleFocDriver(SerialListener):
    """A SimpleFOC drive on a serial port. Options: see `SimpleFocOptions`."""

    kind: ClassVar[str] = "simplefoc"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        settings = self._settings = checked(SimpleFocOptions, name, options)
        super().__init__(name, options, port=settings.port, baudrate=settings.baudrate, keep=False)
        lines = TextDecoder(None, sample_period_s=1.0, columns=settings.format, counters=self.counters)
        self._decoder = MonitorDecoder(lines, ArrivalClock(settings.period_s))

    @property
    def _stream(self) -> MonitorDecoder:
        return self._decoder

    @property
    def meaning(self) -> SignalMeaning:
        return SignalMeaning("instant", "instant", "dq", pole_pairs=self._settings.pole_pairs)

    @property
    def info(self) -> DriveInfo:
        channels = self._settings.format.channels
        return DriveInfo(
            identity=f"simplefoc:{self._settings.port}",
            sample_period_s=self._decoder.clock.period_s,
            current_lsb_A=_DECIMALS * 1e-3 if "current_A" in channels else None,
            voltage_lsb_V=_DECIMALS if "voltage_V" in channels else None,
            channels=channels,
        )

    @property
    def unread(self) -> str | None:
        unread = self._decoder.lines.unread
        if not unread:
            return None
        names = ", ".join(self._settings.format.names)
        return f"a line that is not {names}: {unread.decode('utf-8', 'replace')!r}; the option monitor says what it is"
