"""The signal map: which signal of a foreign file is which column of the capture, as docs/captures.md explains it.

    sheet = "Run 3"                     # options that some formats have
    [signals]
    time_s = { signal = "t_ms", scale = 1e-3 }
    position_rad = { signal = "log.data", column = 3, scale = 0.0174533 }
    voltage_V = { formula = "Duty * Supply", Duty = "pwm", Supply = "U_bus" }
    [metadata]
    mass_kg = 0.49

The same `signals` table as a CAN drive's (`drivers/can/map.py`), which reads it itself where the file is a CAN log.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivers.can.formula import Formula, parse_formula
from servo_daemon.captures.capture.layout import KNOWN_COLUMNS
from servo_daemon.captures.meaning.restored import SHOWS, Shown
from servo_daemon.errors import ConfigError

#: A position in encoder counts; becomes position_rad by `counts_per_rev`.
COUNTS = "position_counts"
TARGETS = (*KNOWN_COLUMNS, COUNTS)

#: Options of the map beside its tables; each format takes some of them.
OPTIONS = ("sheet", "time_base", "counts_per_rev", "dbc", "drive_id", "channel", "trigger", "period_s", "stale_s")

_OPERAND_KEYS = ("signal", "scale", "offset", "column", "row", "group")
#: Keys of a column beside those of its signals.
_COLUMN_KEYS = ("wrap", "formula", "shows", "supply_V", "sum", "rows_late")


@dataclass(frozen=True, slots=True)
class SignalRef:
    """One signal of the file as a column uses it: value = (file's value) × scale + offset.

    Attributes:
        name: its name in the formula; "value" without one.
        signal: its name in the file; in a MAT file, a path.
        column, row: of a matrix in a MAT file, counted from 1.
        group: of an MDF file, where several have a channel of this name: number or acquisition name.
    """

    name: str
    signal: str
    scale: float = 1.0
    offset: float = 0.0
    column: int | None = None
    row: int | None = None
    group: int | str | None = None

    @property
    def label(self) -> str:
        """The signal as messages call it."""
        parts = [f"{key} {value}" for key in ("column", "row", "group") if (value := getattr(self, key)) is not None]
        return " ".join([self.signal, *parts])

    @property
    def entry(self) -> Mapping[str, Any]:
        """The entry as a signal map in TOML would hold it."""
        given = {key: getattr(self, key) for key in _OPERAND_KEYS}
        usual = {"scale": 1.0, "offset": 0.0, "column": None, "row": None, "group": None}
        return {key: value for key, value in given.items() if key not in usual or value != usual[key]}


@dataclass(frozen=True, slots=True)
class MappedColumn:
    """One line of the map.

    Attributes:
        name: one of `TARGETS`.
        operands: the signals in it, at least one.
        formula: how they combine; None: the single operand is the value.
        wrap: the value counts modulo this (in its own unit, before `counts_per_rev`); None: it does not wrap.
        shown: of a current that is not the motor's: what it is instead.
        summed: the signal is what the value has changed by since the sample before.
        rows_late: how many rows below its own the value stands; negative: above.
    """

    name: str
    operands: tuple[SignalRef, ...]
    formula: Formula | None = None
    wrap: float | None = None
    shown: Shown | None = None
    summed: bool = False
    rows_late: int = 0

    @property
    def line(self) -> Mapping[str, Any]:
        """The column's entry in the table `signals`, as it would be written."""
        entry: dict[str, Any] = {}
        if self.formula is None:
            entry |= self.operands[0].entry
        else:
            entry |= {"formula": self.formula.text, **{o.name: o.entry for o in self.operands}}
        told = {"wrap": self.wrap, "sum": self.summed, "rows_late": self.rows_late}
        entry |= {key: value for key, value in told.items() if value}
        if self.shown is not None:
            entry["shows"] = self.shown.shows
            entry |= {} if self.shown.supply_V is None else {"supply_V": self.shown.supply_V}
        return entry


@dataclass(frozen=True, slots=True)
class SignalMap:
    """A signal map as it was written.

    Attributes:
        path: its file, for messages; paths in it are relative to this one's folder.
        signals: the table `signals`, unchecked: its grammar for a CAN log is that of the CAN driver.
        options: the other keys, all among `OPTIONS`.
        metadata: beside the file's own, and instead of them where both have a key.
    """

    path: Path
    signals: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)

    def only(self, known: Collection[str], kind: str) -> None:
        """Refuse options that mean nothing for this kind of file.

        Raises:
            ConfigError: naming the first of them.
        """
        for key in self.options:
            if key not in known:
                takes = f"takes {', '.join(known)}" if known else "takes none"
                raise ConfigError(f"{self.path}: {key}: not an option for {kind}, which {takes}")

    def columns(self) -> tuple[MappedColumn, ...]:
        """The table `signals`, checked.

        Raises:
            ConfigError: one line naming file, column and key.
        """
        if not self.signals:
            raise ConfigError(f"{self.path}: the table [signals] is missing: which signal is which column?")
        for name in self.signals:
            if name not in TARGETS:
                raise ConfigError(f"{self.path}: signals: unknown column '{name}': known are {', '.join(TARGETS)}")
        if COUNTS in self.signals and "position_rad" in self.signals:
            raise ConfigError(f"{self.path}: signals: position_rad and position_counts exclude each other")
        if COUNTS in self.signals and self.counts_per_rev is None:
            raise ConfigError(f"{self.path}: position_counts needs counts_per_rev")
        return tuple(_column(name, entry, f"{self.path}: signals: {name}") for name, entry in self.signals.items())

    @property
    def counts_per_rev(self) -> float | None:
        """Counts of `position_counts` in a revolution; negative turns the direction round.

        Raises:
            ConfigError: not a number other than 0.
        """
        if "counts_per_rev" not in self.options:
            return None
        number = _number(self.options, "counts_per_rev", f"{self.path}")
        if not number:
            raise ConfigError(f"{self.path}: counts_per_rev must not be 0")
        return number

    def positive(self, key: str) -> float | None:
        """An option that must be a number greater than zero.

        Raises:
            ConfigError: it is not.
        """
        if key not in self.options:
            return None
        number = _number(self.options, key, f"{self.path}")
        if number <= 0:
            raise ConfigError(f"{self.path}: {key} must be positive, not {number!r}")
        return number

    def text(self, key: str) -> str | None:
        """An option that must be a text.

        Raises:
            ConfigError: it is not.
        """
        value = self.options.get(key)
        if value is not None and (not isinstance(value, str) or not value):
            raise ConfigError(f"{self.path}: {key} must be a text, not {value!r}")
        return value


def load_signal_map(path: Path | str) -> SignalMap:
    """A signal map from a TOML file.

    Raises:
        ConfigError: the file cannot be read, is not TOML, or has unknown keys; one line naming file and key.
    """
    path = Path(path)
    try:
        document = tomllib.loads(path.read_text("utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not a signal map in TOML: {' '.join(str(error).split())}") from error
    known = ("signals", "metadata", *OPTIONS)
    for key in document:
        if key not in known:
            raise ConfigError(f"{path}: unknown key '{key}': known are {', '.join(known)}")
    signals, metadata = document.pop("signals", {}), document.pop("metadata", {})
    for name, table in (("signals", signals), ("metadata", metadata)):
        if not isinstance(table, dict):
            raise ConfigError(f"{path}: {name} must be a table")
    for key, value in metadata.items():
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise ConfigError(f"{path}: metadata: {key} must be a text or a number, not {value!r}")
    return SignalMap(path, signals, document, {key: str(value) for key, value in metadata.items()})


def _column(name: str, entry: Any, where: str) -> MappedColumn:
    if isinstance(entry, str):
        entry = {"signal": entry}
    if not isinstance(entry, Mapping) or ("signal" in entry) == ("formula" in entry):
        raise ConfigError(f'{where}: must be "name", {{signal = "name", …}} or {{formula = …, Name = …}}')
    wrap = _number(entry, "wrap", where) if "wrap" in entry else None
    if wrap is not None and wrap <= 0:
        raise ConfigError(f"{where}: wrap must be positive, not {wrap!r}")
    shown, summed = _shown(name, entry, where), entry.get("sum", False)
    if not isinstance(summed, bool):
        raise ConfigError(f"{where}: sum must be true or false, not {summed!r}")
    rows_late = entry.get("rows_late", 0)
    if isinstance(rows_late, bool) or not isinstance(rows_late, int) or (rows_late and name == "time_s"):
        raise ConfigError(f"{where}: rows_late must be a whole number, of another column than the time")
    rest = {key: value for key, value in entry.items() if key not in _COLUMN_KEYS}
    if "formula" not in entry:
        return MappedColumn(name, (_operand("value", rest, where),), None, wrap, shown, summed, rows_late)
    if not isinstance(entry["formula"], str):
        raise ConfigError(f"{where}: formula must be a text")
    formula = parse_formula(entry["formula"], where)
    missing = [operand for operand in formula.names if operand not in rest]
    if missing:
        raise ConfigError(f"{where}: the formula uses '{missing[0]}', which is not given a signal")
    for key in rest:
        if key not in formula.names:
            raise ConfigError(f"{where}: unknown key '{key}': the formula has no such name")
    if not rest:
        raise ConfigError(f"{where}: the formula uses no signal")
    operands = tuple(_operand(k, v, f"{where}: {k}") for k, v in rest.items())
    return MappedColumn(name, operands, formula, wrap, shown, summed, rows_late)


def _shown(name: str, entry: Mapping[str, Any], where: str) -> Shown | None:
    """`shows` and `supply_V` of a current."""
    if "shows" not in entry and "supply_V" not in entry:
        return None
    if name != "current_A":
        raise ConfigError(f"{where}: shows and supply_V belong to current_A")
    shows = entry.get("shows")
    if shows not in SHOWS:
        raise ConfigError(f"{where}: shows must be one of {', '.join(SHOWS)}, not {shows!r}")
    if ("supply_V" in entry) != (shows == "supply"):
        raise ConfigError(f'{where}: shows = "supply" needs supply_V, the supply\'s voltage, and nothing else does')
    supply_V = _number(entry, "supply_V", where) if shows == "supply" else None
    if supply_V is not None and supply_V <= 0.0:
        raise ConfigError(f"{where}: supply_V must be positive, not {supply_V!r}")
    return Shown(shows, supply_V)


def _operand(name: str, entry: Any, where: str) -> SignalRef:
    if isinstance(entry, str):
        entry = {"signal": entry}
    if not isinstance(entry, Mapping) or not isinstance(entry.get("signal"), str):
        raise ConfigError(f'{where}: must be "name" or {{signal = "name", …}}')
    for key in entry:
        if key not in _OPERAND_KEYS:
            raise ConfigError(
                f"{where}: unknown key '{key}': known are {', '.join(_OPERAND_KEYS)}, wrap, sum, rows_late"
            )
    scale = _number(entry, "scale", where) if "scale" in entry else 1.0
    if not scale:
        raise ConfigError(f"{where}: scale is 0, which leaves nothing of the signal")
    offset = _number(entry, "offset", where) if "offset" in entry else 0.0
    for key in ("column", "row"):
        value = entry.get(key)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            raise ConfigError(f"{where}: {key} must be a whole number from 1 on, not {value!r}")
    if "column" in entry and "row" in entry:
        raise ConfigError(f"{where}: column and row exclude each other")
    group = entry.get("group")
    if group is not None and (isinstance(group, bool) or not isinstance(group, int | str)):
        raise ConfigError(f"{where}: group must be a number or a name, not {group!r}")
    return SignalRef(name, entry["signal"], scale, offset, entry.get("column"), entry.get("row"), group)


def _number(entry: Mapping[str, Any], key: str, where: str) -> float:
    value = entry[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{where}: {key} must be a number, not {value!r}")
    return float(value)
