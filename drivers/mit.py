"""Driver "mit": the feedback frames of MIT mode actuators (CubeMars AK, Damiao, RobStride), listened to.

A frame has position (16 bits), speed and torque (12 bits) as shares of limits that the model has and the wire does not
tell; RobStride's own protocol has 16 bits each, in frames of 29 bits. Nothing is sent: the controller that commands the
actuator is answered with such a frame each time, and those are listened to. There is no voltage on this wire.

    [drive.options]
    interface = "socketcan"
    channel = "can0"
    model = "AK80-9"
    motor_id = 1
    reply_id = 0             # identifier of its feedback: the master's id of the controller
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from drivers.base import DriveInfo
from drivers.can.decode import EXTENDED, Field, FrameBatch
from drivers.can.map import MappedChannel, Operand, SignalMap
from drivers.can.pace import PacedListener
from drivers.can.vendor import VendorDecoder
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import F64, U8, SampleBlock

#: What may be put on the bus: nothing.
MAY_SEND: frozenset[bytes] = frozenset()

#: Fault 2, mode 2 and host of a RobStride feedback frame are in its identifier, beside the type (2) and the motor.
_ROBSTRIDE_TYPE = 2
_ROBSTRIDE_HOST = 0xFD  # the default of RobStride's tools


@dataclass(frozen=True, slots=True)
class Limits:
    """At the ends of the codes: ±rad, ±rad/s, ±N·m; and how the frame is laid out: mit, damiao or robstride."""

    position_rad: float
    velocity_rad_s: float
    torque_Nm: float
    layout: str = "mit"


#: Sources: CubeMars by TMotorCANControl `mit_can.py` (run: tests/drivers/golden/mit.json); Damiao by `DM_CAN.py` as
#: LeRobot has it; RobStride and CyberGear where the sources agree. Others need `limits`.
MODELS: dict[str, Limits] = {
    "AK80-9": Limits(12.5, 50.0, 18.0),
    "AK10-9": Limits(12.5, 50.0, 65.0),
    "AK60-6": Limits(12.5, 50.0, 15.0),
    "AK80-64": Limits(12.5, 8.0, 144.0),
    "DM4310": Limits(12.5, 30.0, 10.0, "damiao"),
    "DM4310_48V": Limits(12.5, 50.0, 10.0, "damiao"),
    "DM4340": Limits(12.5, 8.0, 28.0, "damiao"),
    "DM4340_48V": Limits(12.5, 10.0, 28.0, "damiao"),
    "DM6006": Limits(12.5, 45.0, 20.0, "damiao"),
    "DM8006": Limits(12.5, 45.0, 40.0, "damiao"),
    "DM8009": Limits(12.5, 45.0, 54.0, "damiao"),
    "DM10010": Limits(12.5, 20.0, 200.0, "damiao"),
    "DM10010L": Limits(12.5, 25.0, 200.0, "damiao"),
    "DMH3510": Limits(12.5, 280.0, 1.0, "damiao"),
    "DMH6215": Limits(12.5, 45.0, 10.0, "damiao"),
    "DMG6220": Limits(12.5, 45.0, 10.0, "damiao"),
    "CyberGear": Limits(4.0 * math.pi, 30.0, 12.0, "robstride"),
    "RS00": Limits(4.0 * math.pi, 33.0, 14.0, "robstride"),
    "RS01": Limits(4.0 * math.pi, 44.0, 17.0, "robstride"),
}
LAYOUTS = ("mit", "damiao", "robstride")
_OPTIONS = ("model", "limits", "layout", "motor_id", "reply_id", "period_s")


@dataclass(frozen=True, slots=True)
class _Clipped(Field):
    """A position that stays at the end of its codes when the shaft goes on: there it is no measurement."""

    def physical(self, data: U8) -> F64:
        raw = self.raw(data).astype(np.int64)
        value: F64 = raw.astype(np.float64) * self.scale + self.offset
        value[(raw == 0) | (raw == (1 << self.length) - 1)] = np.nan
        return value


def _coded(kind: type[Field], key: int, name: str, bits: tuple[int, int], limit: float, selected: Any) -> Field:
    """A share of ±limit in big-endian bits (first bit from the frame's top, length)."""
    first, length = bits
    return kind(
        key=key, name=name, message_bytes=8, first_byte=0, shift=64 - first - length, length=length, big_endian=True,
        signed=False, is_float=False, scale=2.0 * limit / ((1 << length) - 1), offset=-limit, selected_by=selected,
    )  # fmt: skip


def _plain(key: int, name: str, bits: tuple[int, int], scale: float = 1.0, selected: Any = ()) -> Field:
    first, length = bits
    return Field(
        key=key, name=name, message_bytes=8, first_byte=0, shift=64 - first - length, length=length, big_endian=True,
        signed=False, is_float=False, scale=scale, offset=0.0, selected_by=selected,
    )  # fmt: skip


def feedback_map(limits: Limits, key: int, motor_id: int) -> SignalMap:
    """Where position, speed, torque and temperature are in the feedback frames of one motor.

    Args:
        key: identifier of the frames (`frame_key`).
        motor_id: in the frame's first byte (`damiao`: in its lower half, the fault in its upper); robstride's is in
            the identifier.
    """
    selected: tuple[tuple[Field, tuple[int, ...]], ...] = ()
    if limits.layout == "robstride":
        places = ((0, 16), (16, 16), (32, 16))
        temperature = _plain(key, "Feedback.temperature", (48, 16), 0.1)
    else:
        ident, value = ((4, 4), motor_id & 0xF) if limits.layout == "damiao" else ((0, 8), motor_id)
        selected = ((_plain(key, "Feedback.motor", ident), (value,)),)
        places = ((8, 16), (24, 12), (36, 12))
        rotor = (56, 8) if limits.layout == "damiao" else (48, 8)
        temperature = _plain(key, "Feedback.temperature", rotor, selected=selected)
    position = _coded(_Clipped, key, "Feedback.position", places[0], limits.position_rad, selected)
    velocity = _coded(Field, key, "Feedback.velocity", places[1], limits.velocity_rad_s, selected)
    torque = _coded(Field, key, "Feedback.torque", places[2], limits.torque_Nm, selected)

    def channel(name: str, field: Field, wrap: float | None = None) -> MappedChannel:
        return MappedChannel(name, (Operand("value", field, 1.0, 0.0, None),), None, wrap)

    channels = (
        channel("position_rad", position, 2.0 * limits.position_rad),
        channel("velocity_rad_s", velocity),
        channel("torque_Nm", torque),
        channel("temperature_C", temperature),
    )
    return SignalMap(channels, position)


class MitDecoder:
    """Feedback frames of one motor to samples.

    Args:
        frames: of the map's key.
        same: identifiers that mean the same as that key (RobStride: faults and modes are in the identifier).
    """

    def __init__(self, frames: VendorDecoder, key: int, same: frozenset[int], identity: str) -> None:
        self._decoder, self._key, self._same, self._identity = frames, key, same, identity

    @property
    def keys(self) -> frozenset[int]:
        return self._same

    @property
    def info(self) -> DriveInfo:
        of_map = self._decoder.info
        return DriveInfo(self._identity, of_map.sample_period_s, channels=of_map.channels)

    def reset(self) -> None:
        self._decoder.reset()

    def feed(self, batch: FrameBatch) -> list[SampleBlock]:
        if len(self._same) > 1:
            keys = np.where(np.isin(batch.keys, list(self._same)), self._key, batch.keys)
            batch = FrameBatch(
                keys, batch.data, batch.lengths, batch.shortest, batch.stamp_s, batch.host_s, batch.wall_s
            )
        return self._decoder.feed(batch)


class MitDriver(PacedListener):
    """An MIT mode actuator on a CAN bus. Options beside the bus's: `model` or `limits` with `layout`, `motor_id`,
    `reply_id`, `period_s`.

    Raises:
        DriverConfigError: an option is unknown, missing or impossible.
    """

    kind: ClassVar[str] = "mit"

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options, _OPTIONS)
        limits, motor_id = self._limits(), self._number("motor_id", 1, 127)
        reply_id = self._number("reply_id", _ROBSTRIDE_HOST if limits.layout == "robstride" else 0, 0x7FF)
        key, same = _identifiers(limits.layout, motor_id, reply_id)
        frames = VendorDecoder(feedback_map(limits, key, motor_id), self.counters, period_s=self._positive("period_s"))
        where = f"{self._settings['interface']}:{self._settings.get('channel')}"
        self._decoder = MitDecoder(frames, key, same, f"mit:{where}:{motor_id}")
        self._pace(self._decoder, frames, same, self._positive("period_s"))

    def _limits(self) -> Limits:
        model, given = self.options.get("model"), self.options.get("limits")
        if (model is None) == (given is None):
            raise DriverConfigError(f"{self._where}: 'model' or 'limits' is needed, one of them")
        if model is not None:
            if model not in MODELS:
                known = ", ".join(MODELS)
                raise DriverConfigError(
                    f"{self._where}: model {model!r} is none of {known}; for another give limits = [±rad, ±rad/s, ±N·m]"
                )
            return MODELS[model]
        layout = self.options.get("layout", "mit")
        if layout not in LAYOUTS:
            raise DriverConfigError(f"{self._where}: layout {layout!r} is none of {', '.join(LAYOUTS)}")
        numbers = [x for x in given if isinstance(x, int | float) and 0 < x < 1e6] if isinstance(given, list) else []
        if len(numbers) != 3 or numbers != given:
            raise DriverConfigError(f"{self._where}: limits must be three positive numbers, ±rad, ±rad/s and ±N·m")
        position, velocity, torque = map(float, numbers)
        return Limits(position, velocity, torque, layout)

    def _number(self, key: str, default: int, most: int) -> int:
        value = self.options.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
            raise DriverConfigError(f"{self._where}: {key} must be a whole number 0 .. {most}, not {value!r}")
        return value


def _identifiers(layout: str, motor_id: int, reply_id: int) -> tuple[int, frozenset[int]]:
    """The key of the map and all identifiers that mean it. RobStride's has bits 24–28 type, 22–23 mode, 16–21 faults,
    8–15 motor, 0–7 host."""
    if layout != "robstride":
        return reply_id, frozenset({reply_id})
    base = EXTENDED | _ROBSTRIDE_TYPE << 24 | motor_id << 8 | reply_id & 0xFF
    return base, frozenset(base | state << 16 for state in range(256))


def robstride_keys() -> frozenset[int]:
    """Identifiers of the feedback of RobStride motors that have no fault, to the host of RobStride's tools."""
    modes = (mode << 22 for mode in range(4))
    base = EXTENDED | _ROBSTRIDE_TYPE << 24 | _ROBSTRIDE_HOST
    return frozenset(base | mode | motor << 8 for mode in modes for motor in range(1, 128))


def robstride_motor(key: int) -> int | None:
    """The motor whose feedback has this identifier; None: it is none of `robstride_keys`."""
    return key >> 8 & 0xFF if key in _ROBSTRIDE_KEYS else None


_ROBSTRIDE_KEYS = robstride_keys()
