"""Objects of CiA 402 drives that make samples, and where they are in PDOs."""

from __future__ import annotations

import configparser
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.can.decode import Field
from drivers.can.map import COUNTS, MappedChannel, Operand, SignalMap
from servo_daemon.errors import DriverConfigError


@dataclass(frozen=True, slots=True)
class Object:
    """An entry of the object dictionary.

    Attributes:
        channel: what it becomes; empty: it is only passed over in a PDO.
        bits, signed, real: of its value.
        unit: of one step, in the channel's unit or a share of the rated value.
    """

    index: int
    sub: int
    channel: str
    bits: int
    signed: bool = True
    real: bool = False
    unit: float = 1.0

    @property
    def key(self) -> tuple[int, int]:
        return self.index, self.sub


#: CiA 402-2. Velocity has a unit of the maker's; torque and current are ‰ of the rated ones (0x6076, 0x6075).
STANDARD: Mapping[str, Object] = {
    "statusword": Object(0x6041, 0, "", 16, signed=False),
    "mode": Object(0x6061, 0, "", 8),
    "position": Object(0x6064, 0, COUNTS, 32),
    "velocity": Object(0x606C, 0, "velocity_rad_s", 32),
    "torque": Object(0x6077, 0, "torque_Nm", 16, unit=1e-3),
    "current": Object(0x6078, 0, "current_A", 16, unit=1e-3),
    "dc_link": Object(0x6079, 0, "", 32, signed=False),
}
#: Objects of makers for the voltage at the motor (Beckhoff, manuals of AX8000 and EJ7334): Uq in V; coil voltage in mV.
VOLTAGES: Mapping[str, Object] = {
    "beckhoff_ax8000": Object(0x3242, 0x0F, "voltage_V", 32, real=True),
    "beckhoff_ej7334": Object(0x9000, 0x02, "voltage_V", 16, signed=False, unit=1e-3),
}
#: Bytes of a PDO.
_PDO_BITS = 64
#: Transmit PDOs of an EDS: communication and mapping parameters.
_COMMUNICATION, _MAPPING, _PDOS = 0x1800, 0x1A00, 512
_VALID = 0x8000_0000  # bit 31 of a COB-ID: the PDO does not exist


@dataclass(frozen=True, slots=True)
class Scales:
    """What turns steps into units.

    Attributes:
        velocity: rad/s of a step; None: the velocity is not used.
        current_A, torque_Nm: rated.
    """

    velocity: float | None
    current_A: float | None
    torque_Nm: float | None

    def of(self, thing: Object) -> float | None:
        """The channel's unit of one step; None: not known, or no channel."""
        rated = {"velocity_rad_s": self.velocity, "current_A": self.current_A, "torque_Nm": self.torque_Nm}
        factor = rated.get(thing.channel, 1.0 if thing.channel else None)
        return None if factor is None else factor * thing.unit


def named(name: str, voltage: Object | None, where: str) -> Object:
    """The object of a name in the options: of `STANDARD`, "voltage", or "skip16" for what is of no use.

    Raises:
        DriverConfigError: no such name.
    """
    if name == "voltage" and voltage is not None:
        return voltage
    if match := re.fullmatch(r"skip([1-9]|[1-5][0-9]|6[0-4])", name):
        return Object(0, 0, "", int(match[1]))
    if name not in STANDARD:
        known = ", ".join((*STANDARD, "voltage (with the option voltage)", "skip16"))
        raise DriverConfigError(f"{where}: {name!r} is none of {known}")
    return STANDARD[name]


def pdo_map(pdos: Mapping[int, Sequence[Object]], scales: Scales, where: str) -> SignalMap:
    """The signal map of PDOs, by their identifier.

    Raises:
        DriverConfigError: a PDO is too long, or they hold no motion with a torque, current or voltage beside it.
    """
    channels: dict[str, MappedChannel] = {}
    for cob_id, objects in pdos.items():
        at, length = 0, -(-sum(o.bits for o in objects) // 8)
        if length * 8 > _PDO_BITS:
            raise DriverConfigError(f"{where}: the PDO 0x{cob_id:X} has more than 8 bytes")
        for thing in objects:
            unit = scales.of(thing)
            if unit is not None and thing.channel not in channels:
                name = f"PDO{cob_id:X}.{thing.index:X}"
                field = Field(
                    key=cob_id, name=name, message_bytes=length, first_byte=0, shift=at, length=thing.bits,
                    big_endian=False, signed=thing.signed, is_float=thing.real, scale=unit, offset=0.0,
                )  # fmt: skip
                wrap = math.ldexp(1.0, thing.bits) if thing.channel == COUNTS else None
                operand = Operand("value", field, 1.0, 0.0, None)
                channels[thing.channel] = MappedChannel(thing.channel, (operand,), None, wrap)
            at += thing.bits
    usable(tuple(channels), where)
    last = max(pdos)  # a SYNC is answered in the order of the identifiers: with the last one a sample is whole
    trigger = [c.operands[0].field for c in channels.values() if c.operands[0].field.key == last]
    return SignalMap(tuple(channels.values()), (trigger or [c.operands[0].field for c in channels.values()])[0])


def usable(channels: Sequence[str], where: str) -> None:
    """Raise where these channels determine nothing."""
    motion = {COUNTS, "velocity_rad_s"} & set(channels)
    if not motion or not {"torque_Nm", "current_A", "voltage_V"} & set(channels):
        raise DriverConfigError(
            f"{where}: position or velocity (with velocity_unit), and torque (with rated_torque_Nm), current (with"
            " rated_current_A) or voltage are needed"
        )


def eds_pdos(text: str, node_id: int, voltage: Object | None, where: str) -> dict[int, list[Object]]:
    """The transmit PDOs of an EDS or DCF, by identifier, as they are by default.

    Raises:
        DriverConfigError: it is none, or maps nothing.
    """
    eds = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    try:
        eds.read_string(text)
        sections = {name.lower(): eds[name] for name in eds.sections()}
        known = {o.key: o for o in (*STANDARD.values(), *([voltage] if voltage is not None else []))}
        pdos = {}
        for n in range(_PDOS):
            cob_id = _value(sections, _COMMUNICATION + n, 1, node_id)
            count = _value(sections, _MAPPING + n, 0, node_id)
            if cob_id is None or not count or cob_id & _VALID:
                continue
            entries = [_value(sections, _MAPPING + n, k + 1, node_id) or 0 for k in range(min(count, 64))]
            pdos[cob_id & 0x7FF] = [
                known.get((e >> 16, e >> 8 & 0xFF)) or Object(0, 0, "", e & 0xFF) for e in entries if e & 0xFF
            ]
    except (configparser.Error, ValueError) as error:
        reason = " ".join(str(error).split())
        raise DriverConfigError(f"{where}: not an EDS: {reason}") from error
    if not pdos:
        raise DriverConfigError(f"{where}: maps no transmit PDO")
    return pdos


def _value(sections: Mapping[str, Mapping[str, str]], index: int, sub: int, node_id: int) -> int | None:
    section = sections.get(f"{index:x}sub{sub:x}", {})
    text = section.get("parametervalue") or section.get("defaultvalue")
    if not text:
        return None
    terms = text.upper().replace(" ", "").split("+")
    return sum(node_id if term == "$NODEID" else int(term, 0) for term in terms)
