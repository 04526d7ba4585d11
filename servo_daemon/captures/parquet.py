"""Captures in Parquet. pyarrow is an optional extra and imported by name, so that nothing else needs it."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from servo_daemon.captures.layout import Layout, make_layout
from servo_daemon.captures.model import MIN_SAMPLES, Capture, capture_error, first_bad_time
from servo_daemon.errors import BadInputError
from servo_daemon.samples import F64

#: Rows of a row group: Arrow's readers work best with 10^5 and more; 10^5 rows of 5 columns are 4 MB in memory.
_ROW_GROUP = 100_000

#: Schema metadata that belong to other programs.
_FOREIGN = frozenset({"pandas", "ARROW:schema", "huggingface"})


def require_pyarrow(path: Path) -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet.

    Raises:
        BadInputError: they are not installed.
    """
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise BadInputError(
            f"{path}: Parquet needs pyarrow: pip install 'servo-daemon[parquet]', or use .csv.gz"
        ) from error


def read_parquet(path: Path, raw: BinaryIO) -> Capture:
    """A capture from an open Parquet file. Rows count from 1 in messages.

    Raises:
        CaptureError: damaged, or not usable; one line naming file, row and column.
        BadInputError: pyarrow is not installed.
    """
    arrow, parquet = require_pyarrow(path)
    try:
        file = parquet.ParquetFile(raw)
        schema = file.schema_arrow
        stored = {k.decode(errors="replace"): v.decode(errors="replace") for k, v in (schema.metadata or {}).items()}
        metadata = {key: value for key, value in stored.items() if key not in _FOREIGN}
        layout = make_layout(path, schema.names, metadata)
        table = file.read(columns=[name for name, _ in layout.columns.values()])
    except (arrow.ArrowException, OSError) as error:
        raise capture_error(path, f"not a usable Parquet file: {str(error).splitlines()[0]}") from error
    columns = _columns(path, arrow, table, layout)
    n = len(columns["time_s"])
    if n < MIN_SAMPLES:
        raise capture_error(path, f"{n} samples: at least {MIN_SAMPLES} are needed")
    return Capture(path, axis=layout.axis, metadata=metadata, notes=layout.notes, **columns)


def _columns(path: Path, arrow: Any, table: Any, layout: Layout) -> dict[str, F64]:
    columns: dict[str, F64] = {}
    for name, field in layout.columns.values():
        column = table.column(name)
        kind = column.type
        if not (arrow.types.is_floating(kind) or arrow.types.is_integer(kind) or arrow.types.is_decimal(kind)):
            raise capture_error(path, f"holds {kind}, not numbers", column=name)
        # Through double without Arrow's check that every integer is representable; nulls become NaN.
        values = column.cast(arrow.float64(), safe=False).to_numpy()
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise capture_error(path, f"row {bad[0] + 1}: the value is missing or not finite", column=name)
        columns[field] = np.array(values, dtype=np.float64)
    bad_time = first_bad_time(columns["time_s"])
    if bad_time is not None:
        now, before = columns["time_s"][bad_time], columns["time_s"][bad_time - 1]
        how = "is repeated" if now == before else "jumps back"
        message = f"row {bad_time + 1}: time {how}: {float(now)!r} after {float(before)!r}"
        raise capture_error(path, message, column="time_s")
    return columns


class ParquetSink:
    """Columns into an open file, in row groups of about `_ROW_GROUP` rows whatever the blocks' sizes."""

    def __init__(self, file: BinaryIO, names: Sequence[str], metadata: Mapping[str, str]) -> None:
        self._arrow, parquet = require_pyarrow(Path(getattr(file, "name", "capture")))
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
            table = self._arrow.Table.from_arrays([self._arrow.array(a) for a in arrays], schema=self._schema)
            self._writer.write_table(table)
        self._pending.clear()
        self._rows = 0

    def finish(self) -> None:
        """Write what is held back and the file's footer; the file itself stays open."""
        self._write_group()
        self._writer.close()

    def abandon(self) -> None:
        """Nothing more will be written: else ParquetWriter writes its footer when it is collected, into a file that
        is closed by then."""
        self._writer.is_open = False
