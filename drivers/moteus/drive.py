"""Driver "moteus": asks a moteus for its state, over an fdcanusb adapter (`port`) or a CAN FD bus of python-can.

There is no register for the voltage that the drive applies (docs/drives.md), so that R and L are out of reach; torque
(by the drive's own torque constant) or the q current with the motion give J, B and friction, and nothing but `QUERY` is
sent. With `signal = "voltage"` the voltage is read from the diagnostic channel (`voltage.py`), beside the q current.

    [drive.options]
    port = "/dev/fdcanusb"
    drive_id = 1
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field, model_validator

from drivers.base import DriveInfo
from drivers.can.decode import EXTENDED
from drivers.can.unwrap import DeviceTime
from drivers.moteus import fdcanusb, query
from drivers.moteus.answers import Answers
from drivers.moteus.voltage import TO_VOLTAGE, VoltageQuery, voltages
from drivers.options import STRICT, checked
from drivers.polling.can_link import CanLink, Frame, pack, padded
from drivers.polling.driver import PollingDriver
from drivers.polling.link import Link, SerialLink
from drivers.polling.placing import Placing
from drivers.polling.poller import Answer, Pace, Reply, Request
from drivers.polling.when import OneMoment
from drivers.serial.port import open_port
from servo_daemon.errors import DriverError
from servo_daemon.samples import F64, Quality, SampleBlock
from servo_daemon.signal_meaning import SignalMeaning

#: The drive's counter of milliseconds has 32 bits. It tells a restart; the time is the host's, which is finer.
_TURNS = 1 << 32
_PADDED = padded(query.QUERY, query.NOP)


def may_send(drive_id: int) -> tuple[bytes, Frame]:
    """Everything that may leave: the line to an fdcanusb, or the frame on a CAN FD bus."""
    frame_id = query.request_id(drive_id)
    return fdcanusb.sent(frame_id, query.QUERY), Frame(frame_id | EXTENDED, _PADDED)


class MoteusOptions(BaseModel):
    """`[drive.options]` of `driver = "moteus"`: `port` of an fdcanusb, or a bus of python-can.

    `signal` is what drives the mechanics: "torque" as the drive gives it, "current" (then K is needed as a nominal
    value), or "voltage": the current, and beside it the voltage, at 200 Hz.
    """

    model_config = STRICT

    port: str | None = Field(None, min_length=1)
    interface: str | None = Field(None, min_length=1)
    channel: str | int | None = None
    bus: dict[str, Any] = Field(default_factory=dict)
    drive_id: int = Field(1, ge=1, le=query.MOST_ID)
    rate_hz: float | None = Field(None, gt=0, le=4000)
    signal: Literal["torque", "current", "voltage"] = "torque"
    pole_pairs: int = Field(1, ge=1)

    @model_validator(mode="after")
    def _one_link(self) -> MoteusOptions:
        if (self.port is None) == (self.interface is None):
            raise ValueError("'port' (of an fdcanusb) or 'interface' (of a CAN FD bus) is needed, one of them")
        return self

    @property
    def hz(self) -> float:
        """Queries a second: as given, else by what is asked."""
        return self.rate_hz or (200.0 if self.signal == "voltage" else 1000.0)

    @property
    def bus_settings(self) -> dict[str, Any]:
        """Keyword arguments of `can.Bus`."""
        settings: dict[str, Any] = {"interface": self.interface, "fd": True}
        if self.channel is not None:
            settings["channel"] = self.channel
        return settings | self.bus


class Query(Answers):
    """The query and its answers."""

    def __init__(self, drive_id: int, *, text: bool) -> None:
        super().__init__(drive_id, text=text)
        line, frame = may_send(drive_id)
        self._request = Request(line if text else pack(frame))

    def next_request(self) -> Request:
        return self._request

    def feed(self, data: bytes) -> list[Reply[bytes]]:
        """The answers that these bytes complete."""
        mine = self._payloads(data)
        good = [payload for payload in mine if query.is_reply(payload)]
        self._strange += len(mine) - len(good)
        return [Reply(0, payload) for payload in good]


class MoteusDriver(PollingDriver[bytes]):
    """A moteus. Options: see `MoteusOptions`."""

    kind: ClassVar[str] = "moteus"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        self._settings = checked(MoteusOptions, name, options)
        super().__init__(name, options)
        self._placing = Placing(self.counters)
        self._device_time = DeviceTime(1e-3 * _TURNS)
        self._query = self._new_query()

    def _new_query(self) -> Query | VoltageQuery:
        kind = VoltageQuery if self._settings.signal == "voltage" else Query
        self._one_moment = OneMoment()
        return kind(self._settings.drive_id, text=self._settings.port is not None)

    @property
    def remark(self) -> str | None:
        return self._query.unread if isinstance(self._query, VoltageQuery) else None

    @property
    def meaning(self) -> SignalMeaning:
        return SignalMeaning("instant", "instant", "dq", "kt", self._settings.pole_pairs)

    @property
    def info(self) -> DriveInfo:
        s = self._settings
        where = s.port or f"{s.interface}:{s.channel}"
        channels = ("position_rad", "velocity_rad_s", "temperature_C", "torque_Nm")
        return DriveInfo(
            f"moteus:{where}:{s.drive_id}",
            sample_period_s=1.0 / s.hz,
            channels={
                "torque": channels,
                "current": ("current_A", *channels[:3]),
                "voltage": ("voltage_V", "current_A", *channels[:3]),
            }[s.signal],
        )

    @property
    def _pace(self) -> Pace:
        return Pace(self._settings.hz)

    def _open_link(self) -> Link:
        s = self._settings
        if s.port is not None:
            return SerialLink(open_port(self.name, s.port, 921_600))  # USB: the rate is of no account
        try:
            keys = frozenset({query.reply_id(s.drive_id), query.reply_id(s.drive_id) | EXTENDED})
            return CanLink(s.bus_settings, keys, self.counters, fd=True)
        except DriverError as error:
            raise type(error)(f"drive {self.name}: {error}") from error

    def _new_dialogue(self) -> Query | VoltageQuery:
        self._placing.reopen()
        self._device_time = DeviceTime(1e-3 * _TURNS)
        self._query = self._new_query()
        return self._query

    def _samples(self, answers: list[Answer[bytes]]) -> SampleBlock | None:
        self.counters.framing_errors += self._query.take_strange()
        answers = [a for a in answers if a.value]
        self.counters.frames += len(answers)
        if not answers:
            return None
        state = query.replies([a.value for a in answers])
        time_s, number, quality = self._placing.place(answers)
        _, restarted = self._device_time.unwrap(1e-3 * state["counter_ms"], time_s)
        self.counters.device_restarts += int(np.count_nonzero(restarted))
        quality[restarted] |= np.uint8(Quality.TIME_RESTART)
        position, velocity = _of_turns(state["position"]), _of_turns(state["velocity"])
        by_torque = self._settings.signal == "torque"
        drive = _known(state["torque" if by_torque else "q_current"])
        voltage = None
        if self._settings.signal == "voltage":
            voltage = voltages([a.value for a in answers])
            sent_s, received_s = np.array([(a.sent_s, a.received_s) for a in answers]).T
            registers = np.column_stack((position, velocity, drive))
            by = np.full(registers.shape[1], TO_VOLTAGE)
            position, velocity, drive = self._one_moment.moved(registers, sent_s, received_s, by).T.copy()
            quality[np.isnan(voltage)] |= np.uint8(Quality.VOLTAGE_INVALID)
        quality[np.isnan(position)] |= np.uint8(Quality.POSITION_INVALID)
        quality[np.isnan(drive)] |= np.uint8(Quality.CURRENT_INVALID)
        return SampleBlock(
            time_s, number, quality, answers[-1].received_s,
            voltage_V=voltage,
            current_A=None if by_torque else drive,
            torque_Nm=drive if by_torque else None,
            position_rad=position, velocity_rad_s=velocity, temperature_C=state["temperature"].astype(np.float64),
        )  # fmt: skip


def _known(values: np.ndarray[Any, np.dtype[np.float32]]) -> F64:
    """With NaN for all that is no number: the wire may carry any bits."""
    with np.errstate(invalid="ignore"):
        wide = values.astype(np.float64)
    wide[~np.isfinite(wide)] = np.nan
    return wide


def _of_turns(turns: np.ndarray[Any, np.dtype[np.float32]]) -> F64:
    return _known(turns) * (2.0 * math.pi)
