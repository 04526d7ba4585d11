"""ROS's `sensor_msgs/JointState`: joints by name, each with position, velocity and effort, or without one of these.

Of ROS 2 in CDR, the encoding of DDS (OMG Data Distribution Service Interoperability, RTPS 2.5, 10; plain CDR of CORBA
3.3, 9.3): four bytes that tell the byte order, then every number at a multiple of its size from there.

    std_msgs/Header header     int32 sec, uint32 nanosec, string frame_id
    string[] name
    float64[] position, velocity, effort
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

SCHEMAS: Final = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
#: Fields, in the order of the message.
FIELDS: Final = ("position", "velocity", "effort")
_NS: Final = 1_000_000_000
_HEADER: Final = 4  # bytes before the message
#: No robot has so many; a length beyond it is no length.
_MOST: Final = 4096


@dataclass(frozen=True, slots=True)
class JointState:
    """One message.

    Attributes:
        stamp_ns: of its header; 0: not set.
        names: of the joints.
        values: of each field, a number a joint; a field without any is left out.
    """

    stamp_ns: int
    names: tuple[str, ...]
    values: Mapping[str, Sequence[float]]

    def __post_init__(self) -> None:
        for field, values in self.values.items():
            if len(values) != len(self.names):
                raise ValueError(f"{len(self.names)} joints, but {len(values)} of {field}")

    def numbers(self) -> Iterator[tuple[str, float]]:
        """Every number, by joint and field: `shoulder.position`."""
        for field, values in self.values.items():
            for name, value in zip(self.names, values, strict=True):
                yield f"{name}.{field}", value


def from_cdr(data: bytes) -> JointState:
    """A message of ROS 2.

    Raises:
        ValueError: it is none, or cut off.
    """
    if len(data) < _HEADER or data[0] != 0 or data[1] not in (0, 1):
        raise ValueError(f"not plain CDR (it begins with {data[:2].hex() or 'nothing'})")
    read = _Cdr(data, "<" if data[1] == 1 else ">")
    try:
        seconds, nanoseconds = read.number("i"), read.number("I")
        read.text()  # frame_id
        names = tuple(read.text() for _ in range(read.length()))
        values = {field: read.doubles() for field in FIELDS}
    except struct.error as error:
        raise ValueError(f"cut off: {error}") from None
    return JointState(int(seconds) * _NS + int(nanoseconds), names, {f: v for f, v in values.items() if v})


class _Cdr:
    """Reads on from where it is."""

    def __init__(self, data: bytes, order: str) -> None:
        self._data, self._order, self._at = data, order, _HEADER

    def number(self, kind: str) -> float:
        size = struct.calcsize(f"={kind}")
        self._align(size)
        (value,) = struct.unpack_from(self._order + kind, self._data, self._at)
        self._at += size
        return float(value) if kind == "d" else int(value)

    def length(self) -> int:
        count = int(self.number("I"))
        if count > _MOST:
            raise ValueError(f"a length of {count}")
        return count

    def text(self) -> str:
        count = self.length()
        raw = struct.unpack_from(f"{count}s", self._data, self._at)[0]
        self._at += count
        return bytes(raw).rstrip(b"\0").decode()

    def doubles(self) -> tuple[float, ...]:
        count = self.length()
        if not count:
            return ()
        self._align(8)
        values = struct.unpack_from(f"{self._order}{count}d", self._data, self._at)
        self._at += 8 * count
        return values

    def _align(self, size: int) -> None:
        self._at += -(self._at - _HEADER) % size


def from_json(message: Mapping[str, Any]) -> JointState | None:
    """The same as JSON, with the fields of the message; None: it is another one.

    Raises:
        ValueError: it has the fields, and they do not fit.
    """
    names = message.get("name")
    values = {field: message[field] for field in FIELDS if message.get(field)}
    if not isinstance(names, list) or not values or not all(isinstance(n, str) for n in names):
        return None
    for field, numbers in values.items():
        if not isinstance(numbers, list) or not all(isinstance(n, int | float) for n in numbers):
            raise ValueError(f"{field} is no list of numbers")
    header = message.get("header")
    stamp = header.get("stamp") if isinstance(header, Mapping) else None
    return JointState(_stamp_ns(stamp), tuple(names), {f: [float(n) for n in v] for f, v in values.items()})


def _stamp_ns(stamp: Any) -> int:
    """ROS 2 says sec and nanosec, ROS 1 secs and nsecs."""
    if not isinstance(stamp, Mapping):
        return 0
    seconds = stamp.get("sec", stamp.get("secs", 0))
    nanoseconds = stamp.get("nanosec", stamp.get("nsecs", stamp.get("nsec", 0)))
    if not isinstance(seconds, int) or not isinstance(nanoseconds, int):
        raise ValueError("header.stamp is no time")
    return seconds * _NS + nanoseconds
