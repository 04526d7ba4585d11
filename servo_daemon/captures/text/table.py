"""A text table as a recording: its columns by name, with what its preamble tells."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import ClassVar, TextIO

from servo_daemon.captures.capture.layout import KNOWN_COLUMNS, make_layout
from servo_daemon.captures.capture.model import MIN_SAMPLES, Capture, capture_error
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.captures.columns.foreign import Series
from servo_daemon.captures.columns.held import HeldSignal, describe
from servo_daemon.captures.columns.program_logs import INSTANT, simplefoc
from servo_daemon.captures.columns.signal_map import SignalRef
from servo_daemon.captures.columns.understood import only_ours
from servo_daemon.captures.text.dialect import clock_seconds, is_number
from servo_daemon.captures.text.preamble import Preamble
from servo_daemon.captures.text.rows import TextTable
from servo_daemon.column_names import meaning
from servo_daemon.errors import CaptureError
from servo_daemon.samples import F64

#: How numpy.savetxt writes numbers unless told otherwise.
_SAVETXT = re.compile(r"-?\d\.\d{18}e[+-]\d{2,3}")
#: A name that passes a column over.
PASSED = "-"


def with_columns(path: Path, preamble: Preamble, options: ReadOptions) -> Preamble:
    """The preamble with the names that the user gives, in place of a header where there is one.

    Raises:
        CaptureError: not as many as there are columns; or the file has no header and none are given.
    """
    names, guess = options.columns, None if preamble.names else simplefoc(preamble.sample)
    if not names and not preamble.names:
        if guess is None or options.rate_hz is None:
            raise _nameless(path, preamble, guess)
        names = guess[0]
    if guess is not None and tuple(names) == guess[0]:
        preamble = replace(
            preamble, told=("SimpleFOC monitor", *preamble.told), metadata={**INSTANT, **preamble.metadata}
        )
    if not names:
        return preamble
    if len(names) != preamble.width:
        first = ",".join(preamble.sample[0]) if preamble.sample else ""
        message = f"--columns names {len(names)} columns, but the rows have {preamble.width}: {first}"
        raise capture_error(path, message, line=preamble.skip + 1)
    return replace(preamble, names=tuple(names), units=() if options.columns else preamble.units)


def _nameless(path: Path, preamble: Preamble, guess: tuple[tuple[str, ...], float] | None) -> CaptureError:
    """No header: what the user can say, with names that fit as many columns."""
    if guess is not None:
        names, rate_hz = guess
        said = f"it looks like SimpleFOC's monitor: --columns {shlex.quote(','.join(names))} --rate {rate_hz:.4g}"
        why = " (the rate at which its angle is the integral of its speed; say the true one)"
        return capture_error(path, f"no header and no time; {said}{why}", line=preamble.skip + 1)
    shown = ",".join(preamble.sample[0]) if preamble.sample else ""
    said = f"name the {preamble.width} columns in their order, with units, as in  --columns time_ms,voltage_V,mA,rpm"
    if not _rises([row[0] for row in preamble.sample]):
        said += "; where none is a time, also --rate HZ"
    elif preamble.width == 3 and all(_SAVETXT.fullmatch(cell) for row in preamble.sample for cell in row):
        said += "; an ODrive bulk capture of position and current is  --columns time_s,pos_estimate,Iq_measured"
    where = "numbers where the header (time_s,voltage_V,…) should be"
    return capture_error(path, f"{where}: {shown}; {said}", line=preamble.skip + 1)


def _rises(cells: Sequence[str]) -> bool:
    """Whether a column looks like a time: every number is larger than the one before."""
    numbers = [float(cell) if is_number(cell) else clock_seconds(cell) for cell in cells]
    return all(a is not None and b is not None and a < b for a, b in pairwise(numbers)) and len(numbers) > 1


class TableRecording:
    """The columns of an open text table."""

    kind: ClassVar[str] = "CSV"
    options: ClassVar[tuple[str, ...]] = ()
    timed: ClassVar[bool] = False

    def __init__(self, path: Path, text: TextIO, preamble: Preamble, encoding: str) -> None:
        self.path, self.metadata = path, preamble.metadata
        self.header_line: int | None = preamble.line
        self._preamble, self._encoding = preamble, encoding
        self._names = [name.strip() for name in preamble.names]
        likely = {i: n for i, n in enumerate(self._names) if n in KNOWN_COLUMNS or meaning(n) is not None}
        self._table = TextTable(path, text, preamble, likely)
        units = preamble.units or ("",) * len(self._names)
        pairs = zip(self._names, units, strict=True)
        self.held = tuple(HeldSignal("" if n == PASSED else n, unit=u) for n, u in pairs)

    @property
    def is_ours(self) -> bool:
        """Written as our captures are: nothing has to be understood."""
        preamble = self._preamble
        if not preamble.dialect.plain or self._encoding or preamble.told or preamble.units:
            return False
        return only_ours(self._names)

    @property
    def told(self) -> list[str]:
        """In words, what is unusual in how it is written."""
        encoding = [self._encoding] if self._encoding else []
        return [*encoding, *self._preamble.told, *self._table.told]

    def as_it_is(self) -> Capture:
        """The capture of a file that is written as ours are."""
        preamble = self._preamble
        layout = make_layout(
            self.path,
            self._names,
            preamble.metadata,
            line=preamble.line,
            metadata_lines=preamble.metadata_lines,
        )
        found = self._columns({i: name for i, (name, _) in layout.columns.items()})
        columns = {field: found[i] for i, (_, field) in layout.columns.items()}
        self._table.check_time(columns["time_s"])
        notes = (*layout.notes, *self._table.told)
        return Capture(self.path, axis=layout.axis, metadata=preamble.metadata, notes=notes, as_map={}, **columns)

    def _columns(self, wanted: Mapping[int, str]) -> dict[int, F64]:
        found = self._table.columns(wanted)
        n = min((len(column) for column in found.values()), default=0)
        if n < MIN_SAMPLES:
            rows = "a header but no rows" if n == 0 else "only one sample"
            line = self._preamble.line + n
            raise capture_error(self.path, f"{rows}: at least {MIN_SAMPLES} samples are needed", line=line)
        return found

    def read(self, ref: SignalRef) -> Series:
        count = self._names.count(ref.signal)
        if count != 1 or ref.label != ref.signal:
            message = "the column is there twice" if count > 1 else f"no such column; there are {describe(self.held)}"
            raise capture_error(self.path, message, line=self._preamble.line, column=ref.label)
        index = self._names.index(ref.signal)
        return Series(self._columns({index: ref.signal})[index])

    def place(self, index: int) -> str:
        return f"line {self._table.line(index)}"
