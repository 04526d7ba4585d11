"""An ODrive with firmware 0.6 on a CAN bus, asked for arbitrary parameters (SDO): the only way to its q voltage.

Where a parameter is, the maker tells for each firmware in a file `flat_endpoints.json`. A read is answered with the
endpoint and the value:

    node << 5 | 0x04    00  endpoint (2)  00            read (01 would write)
    node << 5 | 0x05    00  endpoint (2)  00  value     little-endian, here a float

The reads of a sample leave together, one behind the other. The voltage is what the current controller's integral part
and its feed-forward ask for; its proportional part is left out, which is L di/dt and noise, so that L is never known.

    [drive.options]
    interface = "socketcan"
    channel = "can0"
    endpoints = "flat_endpoints.json"
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, Field

from drivers.base import DriveInfo
from drivers.can.listener import bus_settings
from drivers.odrive.listening import MEANING, MOST_TURNS, NODES, key_of
from drivers.options import STRICT, checked
from drivers.polling.can_link import CanLink, Frame, pack, unpack
from drivers.polling.driver import PollingDriver
from drivers.polling.link import Link
from drivers.polling.placing import Placing
from drivers.polling.poller import Answer, Pace, Reply, Request
from drivers.polling.when import OneMoment
from servo_daemon.errors import DriverConfigError, DriverError
from servo_daemon.samples import Quality, SampleBlock
from servo_daemon.signal_meaning import CONTROL_PERIOD_S, SignalMeaning

#: Commands of CAN Simple, and the opcode of an endpoint that is read.
GET_VERSION, RX_SDO, TX_SDO = 0x00, 0x04, 0x05
_READ = 0x00
#: What is read for a sample, in this order. The voltage is the sum of the third and the fourth.
ENDPOINTS = (
    "axis0.vel_estimate",
    "axis0.pos_estimate",
    "axis0.motor.foc.v_current_control_integral_q",
    "axis0.motor.foc.Vq_setpoint",
    "axis0.motor.foc.Iq_measured",
)
#: That in the middle: the others are taken to its moment.
_MIDDLE = 2
#: Where in a round trip the drive takes its values no answer tells: between all at once, as the requests come, and
#: evenly until the last answer. They are taken as spread over half of the shortest trip, and may be off by as much.
_SPREAD = 0.5
#: From the moment of each to that of the middle one, as shares of the trip.
_TO_MIDDLE = _SPREAD * (_MIDDLE - np.arange(len(ENDPOINTS))) / len(ENDPOINTS)
_VERSION, _SAMPLE = 1, 0  # tags

#: The values of `ENDPOINTS`, or the firmware's version.
Told = tuple[float, ...]


class SdoOptions(BaseModel):
    """`[drive.options]` of an ODrive that is asked on CAN; `endpoints` is the maker's file for its firmware."""

    model_config = STRICT

    interface: str = Field(min_length=1)
    channel: str | int | None = None
    bitrate: int | None = Field(None, gt=0)
    bus: dict[str, Any] = Field(default_factory=dict)
    endpoints: str = Field(min_length=1)
    firmware: str = Field("0.6", pattern=r"^0\.6$")
    node_id: int = Field(0, ge=NODES[0], le=NODES[-1])
    rate_hz: float = Field(100.0, gt=0, le=500)
    pole_pairs: int = Field(1, ge=1, le=100)


def version_request(node: int) -> Frame:
    """The question for the firmware's version."""
    return Frame(key_of(node, GET_VERSION), b"")


def read_request(node: int, endpoint: int) -> Frame:
    """The question for a parameter."""
    return Frame(key_of(node, RX_SDO), struct.pack("<BHB", _READ, endpoint, 0))


def may_send(node: int, endpoints: tuple[int, ...]) -> frozenset[Frame]:
    """Everything that may be put on the bus."""
    return frozenset({version_request(node), *(read_request(node, endpoint) for endpoint in endpoints)})


def read_endpoints(path: Path, where: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Numbers of `ENDPOINTS`, and the firmware (major, minor, revision) that they are of.

    Raises:
        DriverConfigError: the file cannot be read, is none of the maker's, or lacks one of them.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        table, version = document["endpoints"], str(document["fw_version"])
        told = tuple(int(part) for part in version.split("-", maxsplit=1)[0].lstrip("v").split("."))
        numbers = tuple(int(table[name]["id"]) for name in ENDPOINTS if table[name]["type"] == "float")
    except OSError as error:
        raise DriverConfigError(f"{where}: endpoints {path}: cannot be read: {error.strerror or error}") from error
    except KeyError as error:
        raise DriverConfigError(f"{where}: endpoints {path}: has no {error.args[0]!r}") from error
    except (ValueError, TypeError, RecursionError) as error:
        raise DriverConfigError(f"{where}: endpoints {path}: not the maker's flat_endpoints.json: {error}") from error
    if len(numbers) != len(ENDPOINTS) or len(told) != 3 or not all(0 <= n <= 0xFFFF for n in numbers):
        raise DriverConfigError(f"{where}: endpoints {path}: not the maker's flat_endpoints.json of firmware 0.6")
    return numbers, told


class SdoDialogue:
    """The firmware's version first: endpoints of another one are other parameters. Then the reads, round after round.

    Attributes:
        firmware: what the drive said; None: it has not yet.
        strange: frames that are no answer to what was asked.
    """

    def __init__(self, node: int, endpoints: tuple[int, ...], firmware: tuple[int, ...]) -> None:
        self._node, self._endpoints, self._expected = node, endpoints, firmware
        self._hello = Request(pack(version_request(node)), _VERSION)
        self._reads = Request(b"".join(pack(read_request(node, n)) for n in endpoints), _SAMPLE)
        self._round: dict[int, float] = {}
        self.firmware: tuple[int, ...] | None = None
        self.strange = 0

    @property
    def fits(self) -> bool:
        """Whether the endpoints are those of its firmware."""
        return self.firmware == self._expected

    def next_request(self) -> Request | None:
        self._round = {}
        if self.firmware is None:
            return self._hello
        return self._reads if self.fits else None

    def feed(self, data: bytes) -> list[Reply[Told]]:
        """Whole rounds; a round with an answer missing is none."""
        replies: list[Reply[Told]] = []
        for frame in unpack(data):
            if frame.key == key_of(self._node, GET_VERSION) and len(frame.data) == 8:
                self.firmware = tuple(frame.data[4:7])
                replies.append(Reply(_VERSION, ()))
            elif frame.key == key_of(self._node, TX_SDO) and len(frame.data) == 8:
                _, endpoint, _, value = struct.unpack("<BHBf", frame.data)
                self._round[endpoint] = value
                if set(self._round) >= set(self._endpoints):
                    replies.append(Reply(_SAMPLE, tuple(self._round[n] for n in self._endpoints)))
                    self._round = {}
            else:
                self.strange += 1
        return replies


class SdoOdrive(PollingDriver[Told]):
    """An ODrive that is asked on CAN. Options: see `SdoOptions`.

    Raises:
        DriverConfigError: an option is wrong, or the endpoints cannot be read.
    """

    kind: ClassVar[str] = "odrive"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        settings = self._settings = checked(SdoOptions, name, options)
        where = f"drive {name}"
        self._bus = bus_settings(options, where)
        self.endpoints, self._firmware = read_endpoints(Path(settings.endpoints).expanduser(), where)
        self._placing = Placing(self.counters)
        self._dialogue = SdoDialogue(settings.node_id, self.endpoints, self._firmware)
        self._one_moment = OneMoment()

    @property
    def meaning(self) -> SignalMeaning:
        trip_s = self._one_moment.trip_s
        apart_s = _SPREAD * trip_s if math.isfinite(trip_s) else CONTROL_PERIOD_S
        return SignalMeaning(
            "instant", "instant", "dq", MEANING.publish, self._settings.pole_pairs, control_period_s=apart_s
        )

    @property
    def info(self) -> DriveInfo:
        s = self._settings
        return DriveInfo(
            identity=f"odrive:{s.interface}:{s.channel}:{s.node_id}",
            sample_period_s=1.0 / s.rate_hz,
            channels=("voltage_V", "current_A", "position_rad", "velocity_rad_s"),
        )

    @property
    def remark(self) -> str | None:
        told, wanted = self._dialogue.firmware, ".".join(map(str, self._firmware))
        if told is not None and not self._dialogue.fits:
            return f"its firmware is {'.'.join(map(str, told))}, the endpoints are those of {wanted}"
        return None

    @property
    def _pace(self) -> Pace:
        return Pace(self._settings.rate_hz)

    def _open_link(self) -> Link:
        node = self._settings.node_id
        keys = frozenset({key_of(node, GET_VERSION), key_of(node, TX_SDO)})
        try:
            return CanLink(self._bus, keys, self.counters)
        except DriverError as error:
            raise type(error)(f"drive {self.name}: {error}") from error

    def _new_dialogue(self) -> SdoDialogue:
        self._placing.reopen()
        self._dialogue = SdoDialogue(self._settings.node_id, self.endpoints, self._firmware)
        self._one_moment.restart()
        return self._dialogue

    def _samples(self, answers: list[Answer[Told]]) -> SampleBlock | None:
        strange, self._dialogue.strange = self._dialogue.strange, 0
        self.counters.framing_errors += strange
        rounds = [a for a in answers if a.value]
        self.counters.frames += len(rounds)
        if not rounds:
            return None
        time_s, number, quality = self._placing.place(rounds)
        told = np.array([a.value for a in rounds], np.float64)
        told[~np.isfinite(told)] = np.nan
        sent_s, received_s = np.array([(a.sent_s, a.received_s) for a in rounds]).T
        speed, position, integral, ahead, current = self._one_moment.moved(told, sent_s, received_s, _TO_MIDDLE).T
        voltage = integral + ahead
        position[np.abs(position) >= MOST_TURNS] = np.nan
        for value, invalid in (
            (position, Quality.POSITION_INVALID), (current, Quality.CURRENT_INVALID),
            (voltage, Quality.VOLTAGE_INVALID),
        ):  # fmt: skip
            quality[np.isnan(value)] |= np.uint8(invalid)
        turn = 2.0 * math.pi
        return SampleBlock(
            time_s, number, quality, rounds[-1].received_s,
            voltage_V=voltage, current_A=current.copy(), position_rad=turn * position, velocity_rad_s=turn * speed,
        )  # fmt: skip
