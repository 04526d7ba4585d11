"""Tables of plain rows as Parquet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from servo_daemon.errors import BadInputError
from servo_daemon.extras import require_pyarrow
from servo_daemon.files import AtomicFile


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One file; complete or not there. All rows have the same keys; None is null.

    Raises:
        BadInputError: pyarrow is not installed, or the file cannot be written.
    """
    arrow, parquet = require_pyarrow(path, instead="")
    table = arrow.Table.from_pylist([dict(row) for row in rows])
    with AtomicFile(path) as output:
        parquet.write_table(table, output.file)


def read_table(path: Path) -> list[dict[str, Any]]:
    """The rows of a file.

    Raises:
        BadInputError: pyarrow is not installed, or the file cannot be read.
    """
    _, parquet = require_pyarrow(path, instead="")
    try:
        rows: list[dict[str, Any]] = parquet.read_table(path).to_pylist()
    except (OSError, ValueError) as error:  # pyarrow's own errors are of these kinds
        raise BadInputError(f"{path}: cannot be read as Parquet: {error}") from error
    return rows
