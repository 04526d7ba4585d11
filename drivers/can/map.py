"""The signal map of another maker's drive: `[drive.options.signals]`, checked against the user's DBC.

[drive.options.signals]
position_rad = "Feedback.Angle"
current_A = {signal = "Status1.MotorCurrent", scale = 0.001, offset = 0.0}
voltage_V = {formula = "Duty * Supply", Duty = "Status2.Duty", Supply = "Status3.BusVoltage"}
time_s = {signal = "Feedback.Micros", scale = 1e-6}
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from drivers.can.decode import Field, find_field
from drivers.can.formula import Formula, parse_formula
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import CHANNELS

if TYPE_CHECKING:
    from cantools.database.can import Database

#: What may be mapped besides the channels of a sample.
COUNTS, TIME, SEQUENCE = "position_counts", "time_s", "sequence"
TARGETS = (*CHANNELS, COUNTS, TIME, SEQUENCE)

#: Which channel's message makes a sample, the first of these that is mapped.
TRIGGER_ORDER = ("position_rad", COUNTS, "velocity_rad_s", "current_A", "torque_Nm", "voltage_V", "temperature_C")


@dataclass(frozen=True, slots=True)
class Operand:
    """One signal as a channel uses it: value = (DBC value) × scale + offset."""

    name: str
    field: Field
    scale: float
    offset: float
    stale_s: float | None


@dataclass(frozen=True, slots=True)
class MappedChannel:
    """One line of the map.

    Attributes:
        name: one of `TARGETS`.
        operands: the signals in it, at least one.
        formula: how they combine; None: the single operand is the value.
        wrap: the value counts modulo this (in its own unit); None: it does not wrap.
    """

    name: str
    operands: tuple[Operand, ...]
    formula: Formula | None
    wrap: float | None


@dataclass(frozen=True, slots=True)
class SignalMap:
    """The whole map; `trigger` is the signal whose arrival makes a sample."""

    channels: tuple[MappedChannel, ...]
    trigger: Field

    def get(self, name: str) -> MappedChannel | None:
        """The line for one target, None if it is not mapped."""
        return next((c for c in self.channels if c.name == name), None)

    @property
    def fields(self) -> tuple[Field, ...]:
        """Every signal in use, once."""
        return tuple({o.field.name: o.field for c in self.channels for o in c.operands}.values())


def parse_signal_map(table: Any, database: Database, where: str, trigger: str | None = None) -> SignalMap:
    """Check a `signals` table against the database.

    Args:
        table: the TOML table.
        where: file and drive, for messages.
        trigger: name of the message that makes a sample; None: the one that carries the position, see
            `TRIGGER_ORDER`.

    Raises:
        DriverConfigError: the text names the key, and what would be there instead.
    """
    if not isinstance(table, Mapping) or not table:
        raise DriverConfigError(f"{where}: 'signals' must be a table of at least one signal")
    for name in table:
        if name not in TARGETS:
            raise DriverConfigError(f"{where}: unknown signal key '{name}': known are {', '.join(TARGETS)}")
    if COUNTS in table and "position_rad" in table:
        raise DriverConfigError(f"{where}: position_rad and position_counts exclude each other")
    channels = tuple(_channel(name, table[name], database, f"{where}: {name}") for name in TARGETS if name in table)
    mapped = {c.name: c for c in channels}
    maker = next((mapped[name] for name in TRIGGER_ORDER if name in mapped), None)
    if maker is None:
        raise DriverConfigError(f"{where}: 'signals' maps none of {', '.join(TRIGGER_ORDER)}")
    field = maker.operands[0].field if trigger is None else _trigger_field(channels, trigger, where)
    for name in (TIME, SEQUENCE):
        if name in mapped and mapped[name].operands[0].field.key != field.key:
            raise DriverConfigError(
                f"{where}: {name} must come from the message that makes a sample, which is that of {field.name}"
            )
    return SignalMap(channels, field)


def _trigger_field(channels: tuple[MappedChannel, ...], trigger: Any, where: str) -> Field:
    fields = [o.field for c in channels for o in c.operands]
    for field in fields:
        if field.name.partition(".")[0] == trigger:
            return field
    messages = sorted({f.name.partition(".")[0] for f in fields})
    raise DriverConfigError(f"{where}: trigger = {trigger!r} is none of the mapped messages {', '.join(messages)}")


def _channel(name: str, entry: Any, database: Database, where: str) -> MappedChannel:
    if isinstance(entry, str):
        entry = {"signal": entry}
    if not isinstance(entry, Mapping) or ("signal" in entry) == ("formula" in entry):
        raise DriverConfigError(f'{where}: must be "Message.Signal", {{signal = …}} or {{formula = …, Name = …}}')
    if "formula" not in entry:
        operand = _operand("value", {k: v for k, v in entry.items() if k != "wrap"}, database, where)
        return MappedChannel(name, (operand,), None, _wrap(name, entry, operand, where))
    if name in (TIME, SEQUENCE, COUNTS):
        raise DriverConfigError(f"{where}: a counter is one signal, not a formula")
    if not isinstance(entry["formula"], str):
        raise DriverConfigError(f"{where}: formula must be a text")
    formula = parse_formula(entry["formula"], where)
    given = {k: v for k, v in entry.items() if k not in ("formula", "wrap")}
    for operand_name in formula.names:
        if operand_name not in given:
            raise DriverConfigError(f"{where}: the formula uses '{operand_name}', which is not given a signal")
    for key in given:
        if key not in formula.names:
            raise DriverConfigError(f"{where}: unknown key '{key}': the formula has no such name")
    if not given:
        raise DriverConfigError(f"{where}: the formula uses no signal")
    operands = tuple(_operand(k, v, database, f"{where}: {k}") for k, v in given.items())
    return MappedChannel(name, operands, formula, _number(entry, "wrap", None, where, positive=True))


def _operand(name: str, entry: Any, database: Database, where: str) -> Operand:
    if isinstance(entry, str):
        entry = {"signal": entry}
    if not isinstance(entry, Mapping) or not isinstance(entry.get("signal"), str):
        raise DriverConfigError(f'{where}: must be "Message.Signal" or {{signal = "Message.Signal", …}}')
    for key in entry:
        if key not in ("signal", "scale", "offset", "stale_s"):
            raise DriverConfigError(f"{where}: unknown key '{key}': known are signal, scale, offset, stale_s, wrap")
    scale = _number(entry, "scale", 1.0, where)
    offset = _number(entry, "offset", 0.0, where)
    if not scale:
        raise DriverConfigError(f"{where}: scale is 0, which leaves nothing of the signal")
    return Operand(
        name,
        find_field(database, entry["signal"], where),
        scale,
        offset or 0.0,
        _number(entry, "stale_s", None, where, positive=True),
    )


def _wrap(name: str, entry: Mapping[str, Any], operand: Operand, where: str) -> float | None:
    """A counter wraps where its bits end, unless the map says otherwise."""
    natural = None
    field = operand.field
    if name == SEQUENCE and field.is_float:
        raise DriverConfigError(f"{where}: {field.name} is a float; a running number is an integer")
    if name in (COUNTS, TIME, SEQUENCE) and not field.is_float:
        natural = math.ldexp(abs(field.scale * operand.scale), field.length)
    return _number(entry, "wrap", natural, where, positive=True)


def _number(
    entry: Mapping[str, Any], key: str, default: float | None, where: str, positive: bool = False
) -> float | None:
    value = entry.get(key, default)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise DriverConfigError(f"{where}: {key} must be a number, not {value!r}")
    if positive and value <= 0:
        raise DriverConfigError(f"{where}: {key} must be positive, not {value!r}")
    return float(value)
