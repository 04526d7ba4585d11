"""Sparkplug B's payload: its protobuf messages, as far as an edge node needs them.

Names, numbers and types are those of the specification (Eclipse Sparkplug 3.0, chapter 6, and its sparkplug_b.proto).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from servo_daemon.errors import ConfigError

PACKAGE: Final = "org.eclipse.tahu.protobuf"

#: Fields by message: name, number, type; "*" in front: repeated; those after "|" are one of, named `value`.
_MESSAGES: Final = {
    "Payload": "timestamp:1:uint64 *metrics:2:Metric seq:3:uint64 uuid:4:string body:5:bytes",
    "Metric": (
        "name:1:string alias:2:uint64 timestamp:3:uint64 datatype:4:uint32 is_historical:5:bool is_transient:6:bool "
        "is_null:7:bool properties:9:PropertySet | int_value:10:uint32 long_value:11:uint64 float_value:12:float "
        "double_value:13:double boolean_value:14:bool string_value:15:string bytes_value:16:bytes"
    ),
    "PropertySet": "*keys:1:string *values:2:PropertyValue",
    "PropertyValue": (
        "type:1:uint32 is_null:2:bool | int_value:3:uint32 long_value:4:uint64 float_value:5:float "
        "double_value:6:double boolean_value:7:bool string_value:8:string"
    ),
}
#: Numbers of data types (6.4.16), and the field that holds a value of each.
UINT64, DOUBLE, BOOLEAN, STRING = 8, 10, 11, 12
_FIELD: Final = {UINT64: "long_value", DOUBLE: "double_value", BOOLEAN: "boolean_value", STRING: "string_value"}

Value = float | int | bool | str | None


@dataclass(frozen=True, slots=True)
class Metric:
    """A value to be told.

    Attributes:
        value: None: not known.
        time_s: of the value, UTC seconds since the epoch.
        unit: None: it has none.
    """

    name: str
    datatype: int
    value: Value
    time_s: float
    unit: str | None = None


def encode(
    metrics: Sequence[Metric],
    aliases: Mapping[str, int],
    time_s: float,
    seq: int | None = None,
    *,
    birth: bool = False,
    historical: bool = False,
) -> bytes:
    """A payload.

    Args:
        aliases: by name; a metric without one goes by its name.
        time_s: of sending.
        seq: 0 … 255; None: of a death.
        birth: names, types and units are told beside the aliases.
        historical: the values are of the past.
    """
    payload = messages()["Payload"]()
    payload.timestamp = _milliseconds(time_s)
    if seq is not None:
        payload.seq = seq
    for metric in metrics:
        told, alias = payload.metrics.add(), aliases.get(metric.name)
        told.timestamp = _milliseconds(metric.time_s)
        if birth or alias is None:
            told.name, told.datatype = metric.name, metric.datatype
        if alias is not None:
            told.alias = alias
        if birth and metric.unit:
            told.properties.keys.append("engUnit")
            told.properties.values.add(type=STRING, string_value=metric.unit)
        if historical:
            told.is_historical = True
        if metric.value is None:
            told.is_null = True
        else:
            setattr(told, _FIELD[metric.datatype], metric.value)
    return bytes(payload.SerializeToString())


def is_true(payload: bytes, name: str) -> bool:
    """Whether a command sets the metric of that name."""
    from google.protobuf.message import DecodeError

    try:
        read = messages()["Payload"].FromString(payload)
    except DecodeError:
        return False
    return any(metric.name == name and metric.boolean_value for metric in read.metrics)


@cache
def messages() -> Mapping[str, Any]:
    """The classes of the messages by name.

    Raises:
        ConfigError: protobuf is not installed.
    """
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError as error:
        raise ConfigError("[mqtt] encoding: Sparkplug needs protobuf: pip install 'servo-daemon[mqtt]'") from error
    file = descriptor_pb2.FileDescriptorProto(name="sparkplug_b.proto", package=PACKAGE, syntax="proto2")
    kinds = descriptor_pb2.FieldDescriptorProto
    for name, text in _MESSAGES.items():
        message = file.message_type.add(name=name)
        plain, _, one_of = text.partition("|")
        if one_of:
            message.oneof_decl.add(name="value")
        for entry in (*plain.split(), *one_of.split()):
            field_name, number, kind = entry.lstrip("*").split(":")
            field = message.field.add(name=field_name, number=int(number))
            field.label = kinds.LABEL_REPEATED if entry.startswith("*") else kinds.LABEL_OPTIONAL
            if kind in _MESSAGES:
                field.type, field.type_name = kinds.TYPE_MESSAGE, f".{PACKAGE}.{kind}"
            else:
                field.type = getattr(kinds, f"TYPE_{kind.upper()}")
            if entry in one_of.split():
                field.oneof_index = 0
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    found = {name: pool.FindMessageTypeByName(f"{PACKAGE}.{name}") for name in _MESSAGES}
    return {name: message_factory.GetMessageClass(descriptor) for name, descriptor in found.items()}


def _milliseconds(time_s: float) -> int:
    return max(0, round(time_s * 1e3))
