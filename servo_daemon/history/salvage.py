"""What can be read of a damaged SQLite file, row by row."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import sqlalchemy as sa

from servo_daemon.history import tables
from servo_daemon.history.codec import BlockError, unpack

#: Rows that are copied at once.
_BATCH: Final = 200
#: Rows that cannot be read are stepped over by growing strides; after so many failures in a table the rest is given up.
_MOST_FAILURES: Final = 2000


def salvage(bad: Path, connection: sa.Connection) -> str:
    """Copy what can be read into the (new, empty) tables of `connection`; says in words what that was.

    The order is that of worth: names, events and documents, then blocks, each only if its bytes are whole.
    """
    said = []
    try:
        with closing(sqlite3.connect(f"{bad.absolute().as_uri()}?mode=ro", uri=True)) as old:
            for table in (tables.DRIVE, tables.EVENT, tables.DOCUMENT, tables.BLOCK):
                saved = 0
                batch: list[dict[str, Any]] = []
                for row in _rows(old, table):
                    if _is_whole(table, row):
                        batch.append(row)
                    if len(batch) == _BATCH:
                        saved += _copy(connection, table, batch)
                        batch = []
                saved += _copy(connection, table, batch)
                if table is not tables.DRIVE:
                    said.append(f"{saved} {table.name}s")
    except (sqlite3.Error, OSError):
        pass  # what was copied so far is what there is
    return ", ".join(said) or "nothing"


def _copy(connection: sa.Connection, table: sa.Table, batch: list[dict[str, Any]]) -> int:
    if batch:
        connection.execute(sa.insert(table), batch)
    return len(batch)


def _rows(old: sqlite3.Connection, table: sa.Table) -> Iterator[dict[str, Any]]:
    """All rows that can be read, by id."""
    names = [c.name for c in table.columns]
    query = f"SELECT {', '.join(names)} FROM {table.name} WHERE id >= ? ORDER BY id LIMIT 1"
    at, stride, failures = 0, 1, 0
    while failures < _MOST_FAILURES:
        try:
            row = old.execute(query, (at,)).fetchone()
        except (sqlite3.DatabaseError, UnicodeDecodeError, OverflowError):
            failures += 1
            at, stride = at + stride, min(2 * stride, 4096)
            continue
        if row is None:
            return
        yield dict(zip(names, row, strict=True))
        at, stride = int(row[0]) + 1, 1


def _is_whole(table: sa.Table, row: dict[str, Any]) -> bool:
    if any(value is None for value in row.values()):
        return False
    if table is not tables.BLOCK:
        return True
    try:
        return len(unpack(row["data"])) == int(row["rows"])
    except BlockError:
        return False
