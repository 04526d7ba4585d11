"""From the signals of a foreign file to a capture: what every format but our own CSV and Parquet goes through."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.can.unwrap import WrappedPosition
from servo_daemon.captures.capture.layout import KNOWN_COLUMNS, make_layout
from servo_daemon.captures.capture.model import (
    LINEAR_COLUMNS,
    MIN_SAMPLES,
    Capture,
    capture_error,
    first_bad_time,
    time_fault,
    time_mend,
)
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.captures.columns.foreign import Recording, Series
from servo_daemon.captures.columns.held import describe
from servo_daemon.captures.columns.signal_map import COUNTS, MappedColumn, SignalMap, SignalRef
from servo_daemon.captures.columns.time_base import BASE_ORDER, BRIDGE_FACTOR, Timed, held, same_time, to_one_time
from servo_daemon.captures.columns.understand import understand
from servo_daemon.captures.columns.understood import Understood, field_of
from servo_daemon.captures.meaning.restored import restored_current
from servo_daemon.captures.meaning.windows import travel_of
from servo_daemon.errors import BadInputError, CaptureError, ConfigError
from servo_daemon.numerics import sample_period
from servo_daemon.samples import F64


def assemble(recording: Recording, signal_map: SignalMap | None, options: ReadOptions | None = None) -> Capture:
    """The capture in a recording, checked like any other.

    Args:
        recording: the file.
        signal_map: None: the signals are understood by their names.
        options: what the user tells beside the map.

    Raises:
        CaptureError: a signal is missing, not finite, or its time does not increase; there is no usable set; one line
            that names file, place and signal.
        ConfigError: the map is wrong.
    """
    path, options = recording.path, options or ReadOptions()
    found = Understood()
    if options.columns and recording.header_line is None:
        raise capture_error(path, f"--columns names the columns of text tables; for {recording.kind} use --signals")
    if signal_map is None:
        signal_map, found = SignalMap(path), understand(recording, options)
        columns, per_rev = tuple(found.columns.values()), found.counts_per_rev
    else:
        signal_map.only((*recording.options, "counts_per_rev"), recording.kind)
        if options.counts_per_rev is not None:
            signal_map = replace(signal_map, options={"counts_per_rev": options.counts_per_rev, **signal_map.options})
        columns = _with_time(signal_map.columns(), recording, options)
        per_rev = signal_map.counts_per_rev
    metadata = {**recording.metadata, **found.metadata, **signal_map.metadata}
    series = {column.name: _read_column(recording, column) for column in columns}
    if COUNTS in series:
        assert per_rev is not None  # whoever names the columns asks for it
        counts = series.pop(COUNTS)
        series["position_rad"] = Series(counts.values * (2 * math.pi / per_rev), counts.time_s)
        metadata["counts_per_rev"] = f"{abs(per_rev):g}"
    labels = {column.name.replace(COUNTS, "position_rad"): column.operands[0].label for column in columns}
    names = [*series, *({"time_s"} - series.keys())]
    layout = make_layout(path, names, metadata)
    timed = _timed(recording, series, labels, options.rate_hz)
    time_s, values, notes = _one_time(recording, timed, signal_map)
    time_s, values = _in_their_rows(path, columns, time_s, values)
    understood = _understood(recording, found, time_s, options)
    restored, known = _motor_current(path, columns, time_s, values)
    return Capture(
        path,
        time_s=time_s,
        axis=layout.axis,
        metadata=metadata,
        notes=(*understood, *_unused(recording, columns), *notes, *restored),
        current_known=known,
        as_map={"signals": {column.name: column.line for column in columns}, "counts_per_rev": per_rev},
        **values,
    )


def _understood(recording: Recording, found: Understood, time_s: F64, options: ReadOptions) -> tuple[str, ...]:
    """One line of what was made of a file that is not written as ours are; none of one that is."""
    parts = [*recording.told, *found.told]
    if not parts and options.rate_hz is None:
        return ()
    rate_hz = options.rate_hz or 1.0 / sample_period(time_s)
    size = f"{len(time_s):,} rows at {rate_hz:,.1f} Hz"
    return (", ".join([*recording.told, size, *found.told]),)


def _motor_current(
    path: Path, columns: Sequence[MappedColumn], time_s: F64, values: dict[str, F64]
) -> tuple[tuple[str, ...], NDArray[np.bool_] | None]:
    """Put the motor's current in the place of what the sensor shows; a note, and where it is known."""
    shown = next((column.shown for column in columns if column.shown is not None), None)
    if shown is None:
        return (), None
    voltage = values.get("voltage_V")
    if voltage is None:
        raise capture_error(path, f'shows = "{shown.shows}" needs voltage_V in the map', column="current_A")
    travel = travel_of(time_s, values.get("position_rad"), values.get("velocity_rad_s"))
    try:
        values["current_A"], known = restored_current(shown, time_s, voltage, values["current_A"], travel)
    except BadInputError as error:
        raise capture_error(path, str(error), column="current_A") from error
    how = "its sign from voltage and motion"
    if known is not None:
        how = f"from the supply's by the duty, in {100 * np.mean(known):.0f} % of the samples (the duty is small else)"
    return (f"current_A is the motor's, {how}",), known


def _with_time(
    columns: tuple[MappedColumn, ...], recording: Recording, options: ReadOptions
) -> tuple[MappedColumn, ...]:
    """A signal time_s needs no line in the map."""
    time = [signal for signal in recording.held if signal.short == "time_s"]
    if (
        recording.timed
        or options.rate_hz is not None
        or len(time) != 1
        or any(column.name == "time_s" for column in columns)
    ):
        return columns
    return (MappedColumn("time_s", (SignalRef("value", time[0].name),)), *columns)


def _unused(recording: Recording, columns: Sequence[MappedColumn]) -> tuple[str, ...]:
    used = {operand.signal for column in columns for operand in column.operands}
    ignored = [signal.name or "(no name)" for signal in recording.held if signal.name not in used]
    if not ignored:
        return ()
    more = f" and {len(ignored) - 12} more" if len(ignored) > 12 else ""
    return (f"signal{'s' if len(ignored) > 1 else ''} not used: {', '.join(ignored[:12])}{more}",)


def _read_column(recording: Recording, column: MappedColumn) -> Series:
    """A column's values: signals scaled, combined, unwrapped."""
    parts: dict[str, Series] = {}
    for operand in column.operands:
        one = recording.read(operand)
        bad = np.flatnonzero(~np.isfinite(one.values))
        if bad.size:
            value = float(one.values[bad[0]])
            message = "the value is missing (NaN)" if math.isnan(value) else f"{value!r} is not a finite number"
            raise capture_error(recording.path, message, place=recording.place(int(bad[0])), column=operand.label)
        parts[operand.name] = Series(one.values * operand.scale + operand.offset, one.time_s)
    result = _combined(recording, column, parts)
    if column.wrap is not None:
        result = Series(WrappedPosition(column.wrap).unwrap(result.values), result.time_s)
    if column.summed:
        result = Series(np.cumsum(result.values), result.time_s)
    return result


def _combined(recording: Recording, column: MappedColumn, parts: Mapping[str, Series]) -> Series:
    """The formula's value at the samples of its first signal; the others are held, as on a CAN bus."""
    first = parts[column.operands[0].name]
    if column.formula is None:
        return first
    values: dict[str, F64] = {}
    there = np.ones(len(first.values), np.bool_)
    for operand in column.operands:
        part = parts[operand.name]
        if first.time_s is None or part.time_s is None or same_time(first.time_s, part.time_s):
            if len(part.values) != len(first.values):
                message = f"{len(part.values)} samples, but {column.operands[0].label} has {len(first.values)}"
                raise capture_error(recording.path, message, column=operand.label)
            values[operand.name] = part.values
        else:
            _check_time(recording, part.time_s, operand.label)
            values[operand.name], known = held(Timed(part.time_s, part.values), first.time_s)
            there &= known
    result = np.broadcast_to(column.formula(values), first.values.shape)
    bad = np.flatnonzero(there & ~np.isfinite(result))
    if bad.size:
        message = f"the formula {column.formula.text!r} has no finite value"
        raise capture_error(recording.path, message, place=recording.place(int(bad[0])), column=column.name)
    return Series(result[there], None if first.time_s is None else first.time_s[there])


def _timed(
    recording: Recording, series: dict[str, Series], labels: Mapping[str, str], rate_hz: float | None
) -> dict[str, Timed]:
    """Every column with its time: that of `time_s`, else its own, else what the rate makes of its samples' numbers."""
    path = recording.path
    clock = series.get("time_s")
    timed: dict[str, Timed] = {}
    for name, one in series.items():
        if name == "time_s":
            continue
        time_s, whose = one.time_s, labels[name]
        if clock is not None:
            time_s, whose = clock.values, labels["time_s"]
            foreign = one.time_s is not None and clock.time_s is not None and not same_time(one.time_s, clock.time_s)
            if len(time_s) != len(one.values) or foreign:
                message = f"{len(one.values)} samples, but time_s ({labels['time_s']}) has {len(time_s)}"
                if foreign:
                    message = f"not sampled with time_s ({labels['time_s']}): leave time_s out of the map"
                raise capture_error(path, message, column=labels[name])
        if time_s is None and rate_hz is not None:
            time_s = np.arange(len(one.values)) / rate_hz
        if time_s is None:
            what = f"no time: map time_s, or say --rate; the file holds {describe(recording.held)}"
            raise capture_error(path, what, column=labels[name])
        if len(time_s) < MIN_SAMPLES:
            what = f"{len(time_s)} sample{'s' if len(time_s) != 1 else ''}: at least {MIN_SAMPLES} are needed"
            raise capture_error(path, what, column=labels[name])
        if not any(time_s is other.time_s for other in timed.values()):
            _check_time(recording, time_s, whose)
        timed[KNOWN_COLUMNS[name]] = Timed(time_s, one.values)
    return timed


def _check_time(recording: Recording, time_s: F64, whose: str) -> None:
    bad = first_bad_time(time_s)
    if bad is not None:
        fault = time_fault(float(time_s[bad]), float(time_s[bad - 1]))
        raise capture_error(recording.path, fault + time_mend(fault), place=recording.place(bad), column=whose)
    bad_values = np.flatnonzero(~np.isfinite(time_s))
    if bad_values.size:
        raise capture_error(
            recording.path, "the time is not finite", place=recording.place(int(bad_values[0])), column=whose
        )


def _one_time(
    recording: Recording, timed: dict[str, Timed], signal_map: SignalMap
) -> tuple[F64, dict[str, F64], tuple[str, ...]]:
    """One time for all, and what was done for it."""
    base = _base(signal_map, timed)
    time_s, values, keep = to_one_time(timed, base)
    others = [name for name, one in timed.items() if not same_time(one.time_s, time_s)]
    if not others:
        return time_s, values, ()
    done = []
    if "voltage_V" in others:
        done.append("voltage_V held (its mean from each sample to the next)")
    if rest := [name for name in others if name != "voltage_V"]:
        done.append(f"{', '.join(rest)} interpolated")
    notes = [f"{len(timed)} signals with different sampling, brought to the times of {base}: {'; '.join(done)}"]
    left_out = len(keep) - int(np.count_nonzero(keep))
    if left_out:
        notes.append(
            f"{left_out} of {len(keep)} samples left out, where a signal has not begun, has ended or is silent for "
            f"more than {BRIDGE_FACTOR:g} of its periods"
        )
    if len(keep) - left_out < MIN_SAMPLES:
        spans = ", ".join(f"{k} {v.time_s[0]:g} … {v.time_s[-1]:g} s" for k, v in timed.items())
        raise capture_error(recording.path, f"the signals have no time in common: {spans}")
    return time_s[keep], {name: value[keep] for name, value in values.items()}, tuple(notes)


def _in_their_rows(
    path: Path, columns: Sequence[MappedColumn], time_s: F64, values: dict[str, F64]
) -> tuple[F64, dict[str, F64]]:
    """Values that stand rows below or above their own brought there; rows without all of them are left out."""
    late = {field_of(column.name): column.rows_late for column in columns}
    above, below = max(0, *late.values()), max(0, *(-rows for rows in late.values()))
    kept = len(time_s) - above - below
    if kept < MIN_SAMPLES:
        raise capture_error(path, f"{len(time_s)} rows are too few for rows_late of {max(above, below)}")
    if kept == len(time_s):
        return time_s, values
    return time_s[below:][:kept], {name: one[below + late.get(name, 0) :][:kept] for name, one in values.items()}


def _base(signal_map: SignalMap, timed: Mapping[str, Timed]) -> str:
    wanted = signal_map.text("time_base")
    if wanted is None:
        return next(name for name in BASE_ORDER if name in timed)
    field = {**LINEAR_COLUMNS, COUNTS: "position_rad"}.get(wanted, wanted)
    if field not in timed:
        raise ConfigError(f"{signal_map.path}: time_base: {wanted!r} is none of the columns {', '.join(timed)}")
    return field


def parser_failed(path: Path, what: str, error: Exception) -> CaptureError:
    """A library's complaint about a file, whatever it raised, as one line."""
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return capture_error(path, f"not a usable {what}, or cut off: {reason}")
