"""The payloads a VESC answers with, as values. Layout and scales are those of tests/drivers/golden/vesc.json."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

from drivers.vesc.requests import FW_VERSION, GET_VALUES, GET_VALUES_SELECTIVE
from servo_daemon.errors import WireError

#: An average over no control cycle: 0/0, cast to the least int32, in steps of 0.01 (and 0.001).
NO_AVERAGE = -(1 << 31)


@dataclass(frozen=True, slots=True)
class Value:
    """One field: its name, struct format and steps a unit (0: several of them, left as they are)."""

    name: str
    format: str
    steps: float = 1.0


#: By the bit of a selection mask, in the order in which they follow each other; GET_VALUES sends all.
VALUES = (
    Value("temp_fet_C", "h", 1e1),
    Value("temp_motor_C", "h", 1e1),
    Value("avg_motor_current_A", "i", 1e2),
    Value("avg_input_current_A", "i", 1e2),
    Value("avg_id_A", "i", 1e2),
    Value("avg_iq_A", "i", 1e2),
    Value("duty", "h", 1e3),
    Value("erpm", "i"),
    Value("v_in_V", "h", 1e1),
    Value("amp_hours", "i", 1e4),
    Value("amp_hours_charged", "i", 1e4),
    Value("watt_hours", "i", 1e4),
    Value("watt_hours_charged", "i", 1e4),
    Value("tachometer", "i"),
    Value("tachometer_abs", "i"),
    Value("fault", "B"),
    Value("pid_pos_deg", "i", 1e6),
    Value("controller_id", "B"),
    Value("temp_mos", "6s", 0.0),
    Value("avg_vd_V", "i", 1e3),
    Value("avg_vq_V", "i", 1e3),
    Value("status", "B"),
)
_ALL = (1 << len(VALUES)) - 1


@dataclass(frozen=True, slots=True)
class Firmware:
    """What a VESC says of itself. `uuid` is the controller's serial number in hex, empty where it sends none."""

    major: int
    minor: int
    hardware: str
    uuid: str


@lru_cache(maxsize=64)
def _layout(mask: int) -> tuple[struct.Struct, tuple[Value, ...]]:
    chosen = tuple(value for bit, value in enumerate(VALUES) if mask >> bit & 1)
    return struct.Struct(">" + "".join(value.format for value in chosen)), chosen


def decode_values(payload: bytes) -> tuple[int, dict[str, float]]:
    """Mask and values of an answer to GET_VALUES or GET_VALUES_SELECTIVE. An average over nothing is NaN.

    Raises:
        WireError: another payload, or a length that is not that of its mask.
    """
    command = payload[0] if payload else None
    if command == GET_VALUES:
        mask, body = _ALL, payload[1:]
    elif command == GET_VALUES_SELECTIVE and len(payload) >= 5:
        mask, body = int.from_bytes(payload[1:5], "big"), payload[5:]
    else:
        raise WireError(f"a payload of {len(payload)} bytes, command {command}, holds no values")
    layout, chosen = _layout(mask & _ALL)
    if mask > _ALL or len(body) != layout.size:
        raise WireError(f"{len(body)} bytes do not hold the values of mask 0x{mask:08x}")
    values: dict[str, float] = {}
    for value, raw in zip(chosen, layout.unpack(body), strict=True):
        if value.steps:
            lacks = raw == NO_AVERAGE and value.name.startswith("avg_")
            values[value.name] = float("nan") if lacks else raw / value.steps
    return mask, values


def decode_firmware(payload: bytes) -> Firmware:
    """The answer to FW_VERSION: major, minor, the hardware's name ended by 0, then 12 bytes of serial number.

    Raises:
        WireError: another payload.
    """
    if len(payload) < 3 or payload[0] != FW_VERSION:
        raise WireError(f"a payload of {len(payload)} bytes tells no firmware version")
    name, _, rest = payload[3:].partition(b"\0")
    uuid = rest[:12].hex() if len(rest) >= 12 else ""
    return Firmware(payload[1], payload[2], name.decode("utf-8", "replace"), uuid)
