"""Captures in Parquet. pyarrow is an optional extra and imported by name, so that nothing else needs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from servo_daemon.captures.capture.bounded import check_cells
from servo_daemon.captures.capture.layout import Layout, make_layout
from servo_daemon.captures.capture.model import MIN_SAMPLES, Capture, capture_error, first_bad_time, time_fault
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.captures.columns.foreign import Series
from servo_daemon.captures.columns.held import HeldSignal, describe
from servo_daemon.captures.columns.recording import assemble
from servo_daemon.captures.columns.signal_map import SignalMap, SignalRef
from servo_daemon.captures.columns.understood import only_ours
from servo_daemon.extras import require_pyarrow
from servo_daemon.samples import F64

#: Rows of a row group: Arrow's readers work best with 10^5 and more; 10^5 rows of 5 columns are 4 MB in memory.
_ROW_GROUP = 100_000

#: Schema metadata that belong to other programs.
_FOREIGN = frozenset({"pandas", "ARROW:schema", "huggingface"})


def read_parquet(path: Path, raw: BinaryIO, signal_map: SignalMap | None, options: ReadOptions | None) -> Capture:
    """A capture from an open Parquet file. Rows count from 1 in messages.

    Raises:
        CaptureError: damaged, or not usable; one line naming file, row and column.
        BadInputError: pyarrow is not installed, or the map is wrong.
    """
    arrow, parquet = require_pyarrow(path)
    try:
        file = parquet.ParquetFile(raw)
        schema = file.schema_arrow
        stored = {k.decode(errors="replace"): v.decode(errors="replace") for k, v in (schema.metadata or {}).items()}
        metadata = {key: value for key, value in stored.items() if key not in _FOREIGN}
        if signal_map is not None or options != ReadOptions() or not only_ours(schema.names):
            return assemble(ParquetRecording(path, file, metadata), signal_map, options)
        layout = make_layout(path, schema.names, metadata)
        check_cells(path, file.metadata.num_rows, len(layout.columns))
        table = file.read(columns=[name for name, _ in layout.columns.values()])
    except (arrow.ArrowException, OSError) as error:
        raise capture_error(path, f"not a usable Parquet file: {str(error).splitlines()[0]}") from error
    columns = _columns(path, arrow, table, layout)
    n = len(columns["time_s"])
    if n < MIN_SAMPLES:
        raise capture_error(path, f"{n} samples: at least {MIN_SAMPLES} are needed")
    return Capture(path, axis=layout.axis, metadata=metadata, notes=layout.notes, as_map={}, **columns)


def _columns(path: Path, arrow: Any, table: Any, layout: Layout) -> dict[str, F64]:
    columns: dict[str, F64] = {}
    for name, field in layout.columns.values():
        values = _doubles(path, arrow, table.column(name), name)
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise capture_error(path, f"row {bad[0] + 1}: the value is missing or not finite", column=name)
        columns[field] = values
    bad_time = first_bad_time(columns["time_s"])
    if bad_time is not None:
        fault = time_fault(float(columns["time_s"][bad_time]), float(columns["time_s"][bad_time - 1]))
        raise capture_error(path, f"row {bad_time + 1}: {fault}", column="time_s")
    return columns


def _doubles(path: Path, arrow: Any, column: Any, name: str) -> F64:
    """A column as doubles; nulls become NaN."""
    kind = column.type
    if not (arrow.types.is_floating(kind) or arrow.types.is_integer(kind) or arrow.types.is_decimal(kind)):
        raise capture_error(path, f"holds {kind}, not numbers", column=name)
    # Without Arrow's check that every integer is representable.
    return np.array(column.cast(arrow.float64(), safe=False).to_numpy(), dtype=np.float64)


class ParquetRecording:
    """The columns of a Parquet file, for a signal map."""

    kind: ClassVar[str] = "Parquet"
    options: ClassVar[tuple[str, ...]] = ()
    timed: ClassVar[bool] = False
    header_line: ClassVar[int | None] = None
    told: ClassVar[tuple[str, ...]] = ()

    def __init__(self, path: Path, file: Any, metadata: Mapping[str, str]) -> None:
        self.path, self.metadata, self._file = path, metadata, file
        rows = str(file.metadata.num_rows)
        self.held = tuple(HeldSignal(name, rows) for name in file.schema_arrow.names)

    def read(self, ref: SignalRef) -> Series:
        count = [signal.name for signal in self.held].count(ref.signal)
        if count != 1 or ref.label != ref.signal:
            message = "the column is there twice" if count > 1 else f"no such column; there are {describe(self.held)}"
            raise capture_error(self.path, message, column=ref.label)
        arrow, _ = require_pyarrow(self.path)
        check_cells(self.path, self._file.metadata.num_rows, 1)
        table = self._file.read(columns=[ref.signal])
        return Series(_doubles(self.path, arrow, table.column(ref.signal), ref.signal))

    def place(self, index: int) -> str:
        return f"row {index + 1}"


class ParquetSink:
    """Columns into an open file, in row groups of about `_ROW_GROUP` rows whatever the blocks' sizes."""

    def __init__(self, file: BinaryIO, names: Sequence[str], metadata: Mapping[str, str]) -> None:
        self._arrow, parquet = require_pyarrow()
        fields = [(name, self._arrow.float64()) for name in names]
        self._schema = self._arrow.schema(fields, metadata=dict(metadata))
        self._writer = parquet.ParquetWriter(file, self._schema)
        self._pending: list[Sequence[F64]] = []
        self._rows = 0

    def write(self, columns: Sequence[F64]) -> None:
        """Append equally long columns, in the order of the names."""
        self._pending.append(columns)
        self._rows += len(columns[0])
        if self._rows >= _ROW_GROUP:
            self._write_group()

    def _write_group(self) -> None:
        if self._rows:
            arrays = [np.concatenate(parts) for parts in zip(*self._pending, strict=True)]
            table = self._arrow.Table.from_arrays([self._array(a) for a in arrays], schema=self._schema)
            self._writer.write_table(table)
        self._pending.clear()
        self._rows = 0

    def _array(self, values: F64) -> Any:
        """Without `pyarrow.array`, which imports pandas to ask whether it is one of its series: 36 MB in the daemon."""
        return self._arrow.Array.from_buffers(
            self._arrow.float64(), len(values), [None, self._arrow.py_buffer(np.ascontiguousarray(values))]
        )

    def finish(self) -> None:
        """Write what is held back and the file's footer; the file itself stays open."""
        self._write_group()
        self._writer.close()

    def abandon(self) -> None:
        """Nothing more will be written: else ParquetWriter writes its footer when it is collected, into a file that
        is closed by then."""
        self._writer.is_open = False
