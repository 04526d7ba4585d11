"""Sparkplug payloads read from their bytes by the rules of the protobuf wire format, without protobuf."""

from __future__ import annotations

import struct
from typing import Any

#: By message: field number -> name, and the message it holds. From the specification's chapter 6.
_PAYLOAD = {1: "timestamp", 2: "metrics", 3: "seq"}
_METRIC = {
    1: "name", 2: "alias", 3: "timestamp", 4: "datatype", 5: "is_historical", 7: "is_null", 9: "properties",
    10: "value", 11: "value", 13: "value", 14: "value", 15: "value",
}  # fmt: skip


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _fields(data: bytes) -> list[tuple[int, Any]]:
    found: list[tuple[int, Any]] = []
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        if key & 7 == 0:
            value, at = _varint(data, at)
            found.append((key >> 3, value))
        elif key & 7 == 1:
            found.append((key >> 3, struct.unpack_from("<d", data, at)[0]))
            at += 8
        else:
            assert key & 7 == 2, "no other wire type is used"
            size, at = _varint(data, at)
            found.append((key >> 3, data[at : at + size]))
            at += size
    return found


def read(data: bytes) -> dict[str, Any]:
    """Payload: timestamp, seq (if there is one), and the metrics in order."""
    payload: dict[str, Any] = {"metrics": []}
    for number, value in _fields(data):
        if number == 2:
            metric = {_METRIC[n]: v.decode() if n in (1, 15) else v for n, v in _fields(value)}
            if "properties" in metric:
                metric["properties"] = _properties(metric["properties"])
            payload["metrics"].append(metric)
        else:
            payload[_PAYLOAD[number]] = value
    return payload


def _properties(data: bytes) -> dict[str, str]:
    fields = _fields(data)
    keys = [v.decode() for n, v in fields if n == 1]
    values = [dict(_fields(v)) for n, v in fields if n == 2]
    assert all(v[1] == 12 for v in values)  # String
    return {key: value[8].decode() for key, value in zip(keys, values, strict=True)}
