"""The payloads a VESC answers with, as values. Layout and scales are those of tests/drivers/golden/vesc.json."""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.vesc.requests import FW_VERSION
from servo_daemon.errors import WireError
from servo_daemon.samples import F64

#: An average over no control cycle: 0/0, cast to the least int32, in steps of 0.01 (and 0.001).
NO_AVERAGE = -(1 << 31)


@dataclass(frozen=True, slots=True)
class Value:
    """One field: its name, struct format and steps a unit."""

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
    Value("temp_mos", "6s"),
    Value("avg_vd_V", "i", 1e3),
    Value("avg_vq_V", "i", 1e3),
    Value("status", "B"),
)


@dataclass(frozen=True, slots=True)
class Firmware:
    """What a VESC says of itself. `uuid` is the controller's serial number in hex, empty where it sends none."""

    major: int
    minor: int
    hardware: str
    uuid: str


#: What a poll is read for.
POLLED = ("avg_iq_A", "avg_vq_V", "duty", "pid_pos_deg", "tachometer", "erpm")
#: What a seldom poll is read for. The first of them is the first value of its answer.
CHECKED = ("avg_motor_current_A", *POLLED)


def layout_of(mask: int, names: Collection[str] = POLLED) -> struct.Struct:
    """Of the answer to a selection: command and mask are passed over, then come those of these values that it holds, in
    the order of `VALUES`."""
    chosen = (value for bit, value in enumerate(VALUES) if mask >> bit & 1)
    kinds = (v.format if v.name in names else f"{struct.calcsize('>' + v.format)}x" for v in chosen)
    return struct.Struct(">5x" + "".join(kinds))


def values_of(raw: Sequence[tuple[int, ...]], chosen: Collection[str] = POLLED) -> dict[str, F64]:
    """The values of n answers as `layout_of` unpacks them, by name, shape (n,) each. An average over nothing is NaN.

    Args:
        chosen: names of the values, all of which the answers hold.
    """
    names = [v for v in VALUES if v.name in chosen]
    columns = np.array(raw, np.float64).T
    values = {v.name: column / v.steps for v, column in zip(names, columns, strict=True)}
    for v, column in zip(names, columns, strict=True):
        if v.name.startswith("avg_"):
            values[v.name][column == NO_AVERAGE] = np.nan
    return values


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
