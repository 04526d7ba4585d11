"""Which signal of a file is which column, by the names people use: what is certain is applied and told, what is not is
asked about with the flags that answer it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from drivers.can.formula import parse_formula
from servo_daemon.captures.capture.layout import KNOWN_COLUMNS, MOTION, lacks
from servo_daemon.captures.capture.model import LINEAR_COLUMNS, capture_error
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.captures.columns.by_number import BY_NUMBER, ask_about_the_rest, take_by_number
from servo_daemon.captures.columns.foreign import Recording
from servo_daemon.captures.columns.held import HeldSignal
from servo_daemon.captures.columns.motion_units import match_motion
from servo_daemon.captures.columns.program_logs import ProgramLog, program_log
from servo_daemon.captures.columns.questions import EFFORT_UNITS, UNITS_ASKED, not_understood
from servo_daemon.captures.columns.signal_map import COUNTS, MappedColumn, SignalRef
from servo_daemon.captures.columns.signal_values import (
    Values,
    duty_needs_scale,
    exceeds_one,
    jumps,
    time_scale,
    turns_ratio,
    unit_is_open,
    wrap_of,
)
from servo_daemon.captures.columns.understood import Understood, field_of
from servo_daemon.captures.columns.vesc_log import refuse_mixed
from servo_daemon.captures.meaning.units import full_scale
from servo_daemon.column_names import Meaning, meaning, unit_of
from servo_daemon.samples import F64


def understand(recording: Recording, options: ReadOptions) -> Understood:
    """The columns of a capture among a file's signals.

    Args:
        recording: the file; signals of which values matter are read.

    Raises:
        CaptureError: a column is there twice, or there is no usable set; the text says what would help.
    """
    found = Understood()
    names = [signal.short for signal in recording.held] + (["timestamp"] if recording.timed else [])
    log = program_log(names)
    if log is not None and not options.columns:
        found.told.append(log.name)
        found.metadata |= log.metadata
        refuse_mixed(recording)
    else:
        log = None
        _take_exact(recording, found)
    reader = _Reader(recording, found, options)
    meanings = _meanings(recording.held, log, found)
    for column in dict.fromkeys(m.column for _, m in meanings):
        reader.take(column, [(s, m) for s, m in meanings if m.column == column])
    if log is not None:
        reader.take_formulas(log)
    reader.take_duty()
    reader.take_electrical_speed()
    take_by_number(recording, found, reader.beside, reader.number)
    match_motion(recording, found)
    if {"voltage_V", "current_A"} & found.fields and not (MOTION & found.fields or found.questions):
        ask_about_the_rest(recording, found)
    if options.rate_hz is not None:
        found.columns.pop("time_s", None)
    timed = recording.timed or options.rate_hz is not None
    fields = found.fields | ({"time_s"} if timed else set())
    open_ones = {s: q for s, q in found.questions.items() if field_of(q.column) not in fields}
    lack = lacks(fields)
    if not lack and not (MOTION & fields):
        open_ones = {s: q for s, q in open_ones.items() if field_of(q.column) in MOTION}
        lack = "the motion is not understood" if open_ones else ""
    if lack:
        raise not_understood(recording, lack, open_ones, timed=timed)
    found.told += dict.fromkeys(question.left_out(signal) for signal, question in open_ones.items())
    return found


def _take_exact(recording: Recording, found: Understood) -> None:
    """The signals that are called as a capture's columns are."""
    names = [signal.short for signal in recording.held]
    for signal in recording.held:
        name = signal.short
        if name not in KNOWN_COLUMNS:
            continue
        if names.count(name) > 1:
            several = f"there are {names.count(name)} of this name: say which in a map"
            message = several if recording.header_line is None else "the column is there twice"
            raise capture_error(recording.path, message, line=recording.header_line, column=name)
        unit = unit_of(signal.unit) if signal.unit else None
        own = meaning(name)
        if unit is not None and own is not None and unit[1] != own.scale:
            message = f"its unit is given as {signal.unit}: name it so, {name.partition('_')[0]}_{signal.unit}"
            raise capture_error(recording.path, message, line=recording.header_line, column=name)
        found.columns[name] = MappedColumn(name, (SignalRef("value", signal.name),))


def _meanings(
    held: Sequence[HeldSignal], log: ProgramLog | None, found: Understood
) -> list[tuple[HeldSignal, Meaning]]:
    """What the other signals mean, one axis: a rotary one where both are there and no name of ours decides."""
    meant = []
    for signal in held:
        if signal.short in found.columns or signal.columns:
            continue
        what = log.meanings.get(signal.short.rpartition(".")[2]) if log else meaning(signal.short, signal.unit)
        if what is not None:
            meant.append((signal, what))
    if log is not None:  # of two that mean the same the one that the log's description has first, of its main channel
        order = [*log.meanings]
        meant.sort(key=lambda c: (order.index(c[0].short.rpartition(".")[2]), not c[0].name.startswith(log.channel)))
        return [c for k, c in enumerate(meant) if c[1].column not in {m.column for _, m in meant[:k]}]
    exact = {name for name in found.columns if name != "time_s"}
    linear = bool(exact & LINEAR_COLUMNS.keys())
    rotary = bool(exact & {*LINEAR_COLUMNS.values()}) or (
        not linear and any(m.column in LINEAR_COLUMNS.values() and m.certain for _, m in meant)
    )
    unwanted = {*LINEAR_COLUMNS} if rotary else {*LINEAR_COLUMNS.values(), COUNTS} if linear else set()
    return [(s, m) for s, m in meant if m.column not in unwanted]


class _Reader:
    """Takes signals for columns, with a look at their values where these tell more than the names."""

    def __init__(self, recording: Recording, found: Understood, options: ReadOptions) -> None:
        self._recording, self._found, self._options = recording, found, options
        self.beside: dict[str, tuple[HeldSignal, Meaning]] = {}

    def take(self, column: str, candidates: list[tuple[HeldSignal, Meaning]]) -> None:
        """The signal among candidates that is this column; a question where that is not certain."""
        found = self._found
        taken = field_of(column) in found.fields
        if taken or (column == "time_s" and self._options.rate_hz is not None):
            return
        best = [c for c in candidates if c[1].told] or [c for c in candidates if c[1].certain] or candidates
        if len(best) > 1:
            names = " or ".join(s.name for s, _ in best[:4])
            for signal, _ in best:
                found.ask(signal.name, column, f"which is {column}: {names}?")
            return
        signal, what = best[0]
        if column in ("duty", "supply", "erpm", *BY_NUMBER):
            self.beside[column] = (signal, what)
        elif not what.certain:
            self._ask_unit(signal, column)
        elif column == COUNTS:
            self._take_counts(signal)
        else:
            self._take_plain(signal, what)

    def _values(self, signal: HeldSignal) -> Values:
        return Values(self._recording.read(SignalRef("value", signal.name)).values)

    def _ask_unit(self, signal: HeldSignal, column: str, why: str = "its unit is not in its name") -> None:
        effort = column == "torque_Nm" and "effort" in signal.short.lower()
        if units := EFFORT_UNITS if effort else UNITS_ASKED.get(column):
            self._found.ask(signal.name, column, f"{signal.name}: {why}", units)

    def _take_plain(self, signal: HeldSignal, what: Meaning) -> None:
        column, scale = what.column, what.scale
        if not what.told or column in ("time_s", "position_rad"):
            values = self._values(signal)
        if column == "time_s":
            found = scale if what.told else time_scale(values)
            if found is None:
                return self._ask_unit(signal, column, "in seconds it is no drive's time")
            scale = found
        elif not what.told and unit_is_open(column, values):
            return self._ask_unit(signal, column, "whole numbers, and no unit in its name")
        wrap = wrap_of(column, scale, values) if column in ("time_s", "position_rad") else None
        how = "" if what.told or column == "time_s" else " (no unit told)"
        self._add(MappedColumn(column, (SignalRef("value", signal.name, scale),), None, wrap), signal.name, how)
        return None

    def _take_counts(self, signal: HeldSignal) -> None:
        per_rev = self.number("counts_per_rev")
        if per_rev is None:
            text = (
                f"{signal.name} counts: --counts-per-rev N says how often in a turn (after quadrature); in a map, "
                f'position_counts = "{signal.name}" with counts_per_rev = N'
            )
            self._found.ask(signal.name, COUNTS, text)
            return
        wrap = wrap_of(COUNTS, abs(per_rev), self._values(signal))
        self._found.counts_per_rev = per_rev
        column = MappedColumn(COUNTS, (SignalRef("value", signal.name),), None, wrap)
        self._add(column, signal.name, f" (÷ {per_rev:,.10g} a turn)")

    def take_formulas(self, log: ProgramLog) -> None:
        """Columns that are computed."""
        for column, (text, operands) in log.formulas.items():
            refs = tuple(SignalRef(name, name) for name in operands)
            formula = parse_formula(text, f"{self._recording.path}: {column}")
            self._add(MappedColumn(column, refs, formula), f"q axis of {', '.join(operands[:-1])}")

    def take_duty(self) -> None:
        """The voltage by a duty cycle, where it is not there itself, or is the supply's."""
        self._know_the_supply()
        if "duty" not in self.beside or "voltage_V" in self._found.fields:
            return
        signal, what = self.beside["duty"]
        values, full = self._values(signal), self._options.full_duty
        volts, supply = self.number("supply_V"), self.beside.get("supply")
        beyond = full is None and exceeds_one(values, what.scale)
        unsure = beyond or (self._options.supply_V is None and duty_needs_scale(values, what.scale))
        scale = what.scale / (full or 1.0)
        if supply is not None and not unsure and (volts is None or full is not None):
            other, unit = supply
            refs = (SignalRef("Duty", signal.name, scale), SignalRef("Supply", other.name, unit.scale))
            formula = parse_formula("Duty * Supply", f"{self._recording.path}: voltage_V")
            told = f" (full at {full:g})" if full else ""
            self._add(MappedColumn("voltage_V", refs, formula), f"{signal.name} × {other.name}", told)
        elif volts is not None and not unsure:
            column = MappedColumn("voltage_V", (SignalRef("value", signal.name, scale * volts),))
            self._add(column, signal.name, f" (× {scale * volts:.6g} V)")
        else:
            text, top = f"{signal.name} is a share of {supply[0].name if supply else 'the supply'}", values.largest
            if beyond and values.whole and (end := full_scale(top)):
                text += f" and goes to {top:g}: --supply {volts or 12:g}/{end:g} (volts at {end:g}) says of which"
            else:
                text += ": --supply 12 (volts at 1) or 12/255 (at 255) says of which"
            self._found.ask(signal.name, "voltage_V", text)

    def _know_the_supply(self) -> None:
        """A voltage that stands while the duty cycle changes is the supply's: "vin [V]" beside "PWM [%]"."""
        column = self._found.columns.get("voltage_V")
        if "duty" not in self.beside or column is None or column.operands[0].signal == column.name:
            return
        signal = next(s for s in self._recording.held if s.name == column.operands[0].signal)
        if self._values(signal).stands and not self._values(self.beside["duty"][0]).stands:
            self._drop(column)
            self.beside.setdefault("supply", (signal, Meaning("supply", column.operands[0].scale)))

    def take_electrical_speed(self) -> None:
        """The shaft's speed by the electrical one, where no motion is there itself."""
        if "erpm" not in self.beside:
            return None
        signal, what = self.beside["erpm"]
        pairs = self.number("pole_pairs")
        moving = self._found.columns.get("position_rad")
        if moving is not None and moving.operands[0].signal == "encoder_position":
            told = self._encoder_ratio(moving, signal, what)
            if told is None or (pairs is not None and round(told) != pairs):
                self._drop(moving)  # stands still, or is the electrical angle: no shaft's position
            else:
                self._found.metadata.setdefault("pole_pairs", f"{told:.0f}")
                if moving.wrap is None and jumps(self._values_of(moving)):
                    self._drop(moving)  # which way round it went from row to row is not known
                    pairs = told
        if MOTION & self._found.fields:
            return None
        if pairs is None:
            asked = f"{signal.name} is the electrical speed: --pole-pairs N makes it the shaft's"
            return self._found.ask(signal.name, "velocity_rad_s", asked)
        column = MappedColumn("velocity_rad_s", (SignalRef("value", signal.name, what.scale / pairs),))
        return self._add(column, signal.name, f" (÷ {pairs:g} pole pairs)")

    def _encoder_ratio(self, moving: MappedColumn, signal: HeldSignal, what: Meaning) -> float | None:
        """Pole pairs by what an encoder's angle and the electrical speed make of each other; None: the angle is not the
        shaft's (it stands still, or turns as the electrical one)."""
        time = self._found.columns.get("time_s")
        if time is None:
            return None
        angle = self._values_of(moving)
        seconds = self._recording.read(time.operands[0]).values * time.operands[0].scale
        speed = self._recording.read(SignalRef("value", signal.name)).values * what.scale
        return turns_ratio(seconds, angle, speed)

    def _values_of(self, column: MappedColumn) -> F64:
        """Of a column that is one signal."""
        ref = column.operands[0]
        return self._recording.read(ref).values * ref.scale

    def _drop(self, column: MappedColumn) -> None:
        del self._found.columns[column.name]
        self._found.told = [t for t in self._found.told if not t.startswith(f"{column.operands[0].signal} → ")]

    def number(self, key: str) -> float | None:
        """A number by its flag, else by the file's metadata."""
        text = self._recording.metadata.get(key)
        told: float | None = getattr(self._options, key)
        if told is not None or text is None:
            return told
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or value == 0.0:
            raise capture_error(self._recording.path, f"metadata {key}: {text!r} is not a number other than zero")
        return value

    def _add(self, column: MappedColumn, source: str, how: str = "") -> None:
        self._found.columns[column.name] = column
        wrapped = f", continued over {column.wrap:.10g}" if column.wrap else ""
        shown = "position_rad" if column.name == COUNTS else column.name
        self._found.told.append(f"{source} → {shown}{how}{wrapped}")
