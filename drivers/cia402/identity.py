"""What a CANopen node says of itself when it is asked: reads by SDO, sent by `servo-daemon scan --ask`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from drivers.base import DriverCounters
from drivers.cia402.objects import Object
from drivers.cia402.sdo import ANSWER_ID, answer, number, upload
from drivers.polling.can_link import CanLink, pack, unpack

#: CiA 301: device type, with the profile's number in its lower half. CiA 402-2: rated current (mA) and torque (mN·m),
#: increments of the encoder for so many turns of the motor.
IDENTITY: Mapping[str, Object] = {
    "device_type": Object(0x1000, 0, "", 32, signed=False),
    "rated_current_mA": Object(0x6075, 0, "", 32, signed=False),
    "rated_torque_mNm": Object(0x6076, 0, "", 32, signed=False),
    "increments": Object(0x608F, 1, "", 32, signed=False),
    "turns": Object(0x608F, 2, "", 32, signed=False),
}
#: Device profile of drives, the lower half of the device type (CiA 402).
PROFILE = 402
#: A node answers within some milliseconds; one that does not in so many seconds has no SDO server.
_PATIENCE_S = 0.2


def read_identity(settings: Mapping[str, Any], node_id: int) -> dict[str, float]:
    """The objects of `IDENTITY` that a node gives, by name; empty where it does not answer at all.

    Args:
        settings: keyword arguments of `can.Bus`.

    Raises:
        DriverUnavailableError, DriverConfigError: the bus cannot be opened.
        OSError: it goes away.
    """
    link = CanLink(settings, frozenset({ANSWER_ID + node_id}), DriverCounters())
    found: dict[str, float] = {}
    try:
        for name, thing in IDENTITY.items():
            link.send(pack(upload(node_id, thing)))
            data = _answer_to(link, thing)
            if data is None:
                return found
            value = number(thing, data)
            if value is not None:
                found[name] = value
    finally:
        link.close()
    return found


def _answer_to(link: CanLink, thing: Object) -> bytes | None:
    """The value of an object as it came, empty where it is refused; None: no answer."""
    end = time.monotonic() + _PATIENCE_S
    while (left := end - time.monotonic()) > 0.0:
        for frame in unpack(link.receive(left)):
            read = answer(frame.data)
            if read is not None and read[0] == thing.key:
                return read[1] or b""
    return None


def options_of(identity: Mapping[str, float]) -> dict[str, float]:
    """What the drive's answers make of the driver's options; none of them where it does not say it."""
    options = {}
    turns, increments = identity.get("turns", 0.0), identity.get("increments", 0.0)
    if turns > 0.0 and increments > 0.0:
        options["counts_per_rev"] = increments / turns
    for name, option in (("rated_torque_mNm", "rated_torque_Nm"), ("rated_current_mA", "rated_current_A")):
        if identity.get(name, 0.0) > 0.0:
            options[option] = 1e-3 * identity[name]
    return options
