"""An ODrive with firmware 0.5 on USB or UART: its text protocol, asked for position, velocity and Iq.

The two questions of a sample leave together; the drive answers them one after the other, some tenths of a millisecond
apart. There is no applied voltage in these answers, so R and L cannot be known from them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from drivers.base import DriveInfo, DriverCounters
from drivers.odrive.listening import MEANING
from drivers.options import checked
from drivers.polling.driver import PollingDriver
from drivers.polling.link import SerialLink
from drivers.polling.poller import Answer, Pace, Reply, Request
from drivers.polling.when import SampleTimes
from drivers.serial.port import open_port
from servo_daemon.samples import Quality, SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

#: All that the driver ever sends, by axis: feedback (position and velocity), and one reading.
MAY_SEND: dict[int, bytes] = {
    axis: f"f {axis}\nr axis{axis}.motor.current_control.Iq_measured\n".encode() for axis in (0, 1)
}
#: What `scan` sends once, by axis: the torque constant, N·m/A.
TORQUE_CONSTANT: dict[int, bytes] = {axis: f"r axis{axis}.motor.config.torque_constant\n".encode() for axis in (0, 1)}
#: A line longer than this is none of its answers.
_LONGEST_LINE = 128


class OdriveOptions(BaseModel):
    """`[drive.options]` of an ODrive on a serial line."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    port: str = Field(min_length=1)
    baudrate: int = Field(115200, gt=0)
    rate_hz: float = Field(100.0, gt=0, le=500)
    axis: Literal[0, 1] = 0


@dataclass(frozen=True, slots=True)
class Told:
    """Answers to the two questions of one sample: turns, turns/s, A."""

    position: float
    velocity: float
    iq_A: float


class OdriveDialogue:
    """The questions of one axis and the lines that answer them.

    Attributes:
        refused: the last line that was none of the answers, if no answer has come since.
    """

    def __init__(self, axis: int, counters: DriverCounters) -> None:
        self._request, self._counters = Request(MAY_SEND[axis]), counters
        self._rest = b""
        self._feedback: tuple[float, ...] | None = None
        self.refused: str | None = None

    def next_request(self) -> Request:
        return self._request

    def feed(self, data: bytes) -> list[Reply[Told]]:
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest if len(rest) <= _LONGEST_LINE else b""
        replies = []
        for line in filter(None, (line.strip() for line in lines)):
            numbers = _numbers(line)
            if numbers is None:
                self._counters.framing_errors += 1
                self.refused, self._feedback = line[:_LONGEST_LINE].decode("utf-8", "replace"), None
            elif len(numbers) == 2:
                self._feedback = numbers
            elif self._feedback is not None:
                self._counters.frames += 1
                position, velocity = self._feedback
                replies.append(Reply(0, Told(position, velocity, numbers[0])))
                self._feedback = self.refused = None
        return replies


def _numbers(line: bytes) -> tuple[float, ...] | None:
    """One or two numbers; None: the line is something else."""
    try:
        numbers = tuple(map(float, line.split()))
    except ValueError:
        return None
    return numbers if 1 <= len(numbers) <= 2 else None


class AskedOdrive(PollingDriver[Told]):
    """An ODrive that is asked. Options: see `OdriveOptions`."""

    kind: ClassVar[str] = "odrive"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        self._settings = checked(OdriveOptions, name, options)
        self._when = SampleTimes()
        self._dialogue = self._new_dialogue()
        self._last_number: int | None = None

    @property
    def meaning(self) -> SignalMeaning:
        return MEANING

    @property
    def info(self) -> DriveInfo:
        return DriveInfo(
            identity=f"odrive:{self._settings.port}:{self._settings.axis}",
            sample_period_s=1.0 / self._settings.rate_hz,
            channels=("current_A", "position_rad", "velocity_rad_s"),
        )

    @property
    def remark(self) -> str | None:
        refused = self._dialogue.refused
        if refused is not None:
            return f"it answers {refused!r}: its text protocol is that of firmware 0.5"
        return None

    @property
    def _pace(self) -> Pace:
        return Pace(self._settings.rate_hz, timeout_s=max(0.1, 4.0 / self._settings.rate_hz))

    def _open_link(self) -> SerialLink:
        return SerialLink(open_port(self.name, self._settings.port, self._settings.baudrate))

    def _new_dialogue(self) -> OdriveDialogue:
        self._dialogue = OdriveDialogue(self._settings.axis, self.counters)
        self._last_number = None
        self._when.restart()
        return self._dialogue

    def _samples(self, answers: list[Answer[Told]]) -> SampleBlock:
        number = np.array([a.number for a in answers], np.int64)
        told = np.array([(a.value.position, a.value.velocity, a.value.iq_A) for a in answers], np.float64)
        steps = np.diff(number, prepend=number[0] - 1 if self._last_number is None else self._last_number)
        self._last_number = int(number[-1])
        self.counters.samples_lost += int((steps - 1).sum()) if len(steps) else 0
        quality = np.where(steps > 1, np.uint8(Quality.GAP_BEFORE), np.uint8(0))
        finite = np.isfinite(told)
        quality[~finite[:, 2]] |= int(Quality.CURRENT_INVALID)
        quality[~finite[:, 0]] |= int(Quality.POSITION_INVALID)
        position, velocity, current = np.where(finite, told, np.nan).T
        angle, speed = 2.0 * math.pi * position, 2.0 * math.pi * velocity
        sent_s, received_s = np.array([(a.sent_s, a.received_s) for a in answers]).T
        return SampleBlock(
            self._when.times(sent_s, received_s, angle, speed), number, quality, answers[-1].received_s,
            current_A=current.copy(), position_rad=angle, velocity_rad_s=speed,
        )  # fmt: skip
